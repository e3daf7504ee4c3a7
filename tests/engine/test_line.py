"""The line: when it may be spoken on."""

from __future__ import annotations

from typing import Any

import pytest

from servobus.engine.line import BABBLE, ECHO_LIMIT, QUIET, START_QUIET, EchoFilter, Line
from servobus.protocols.base import LineTraits

FRAME = bytes(10)
MS = 0.001


def opened(at: float = 0.0, **traits: Any) -> Line:
    line = Line(LineTraits(**traits))
    line.opened(at)
    return line


def ready(line: Line, now: float, *, estop_pending: bool = False) -> float:
    """When the next frame may leave, as the master does it: what was listened out is over then."""
    at = line.ready_at(now, estop_pending=estop_pending)
    if at <= now and line.waiting_for_silence:
        line.end_wait()
    return at


def quiet_line(**traits: Any) -> Line:
    """Opened long ago, and listened out: it may be spoken on from 1 s on."""
    line = opened(**traits)
    assert ready(line, 1.0) <= 1.0
    return line


# Quiet


def test_after_the_port_opened_the_line_must_be_silent() -> None:
    line = opened(5.0)
    assert line.waiting_for_silence
    assert line.ready_at(5.0, estop_pending=False) == line.ready_at(5.0, estop_pending=True) == 5.0 + START_QUIET
    assert line.ready_at(5.0 + START_QUIET, estop_pending=False) <= 5.0 + START_QUIET
    line.end_wait()
    assert not line.waiting_for_silence


def test_after_a_miss_it_is_listened_out_until_it_was_quiet() -> None:
    line = quiet_line()
    line.wait_for_silence(2.0)
    assert line.ready_at(2.0, estop_pending=False) == 2.0 + QUIET
    line.wait_for_silence(2.001)
    assert line.ready_at(2.0 + QUIET, estop_pending=False) == 2.001 + QUIET, "something was heard meanwhile"
    assert ready(line, 2.001 + QUIET) <= 2.001 + QUIET
    assert line.drains == 2, "the opening and this"


def test_bytes_that_arrive_do_not_shorten_a_longer_silence() -> None:
    line = opened(5.0)
    line.wait_for_silence(5.001)
    assert line.ready_at(5.002, estop_pending=False) == 5.0 + START_QUIET


def test_a_slow_line_is_quiet_only_after_two_bytes_could_have_come() -> None:
    line = quiet_line(baudrate=1000)
    line.wait_for_silence(2.0)
    assert line.ready_at(2.0, estop_pending=False) == pytest.approx(2.02)


def test_a_line_opened_again_starts_anew() -> None:
    line = quiet_line(baudrate=10_000)
    line.send(FRAME, 1.0, 60.0)
    line.opened(2.0)
    assert line.ready_at(2.0, estop_pending=False) == 2.0 + START_QUIET
    assert ready(line, 2.0 + START_QUIET) <= 2.0 + START_QUIET


# Babble


def babbling(until: float) -> tuple[Line, float]:
    """A line on which bytes have come every millisecond since 1 s."""
    line, now = quiet_line(), 1.0
    while now <= until:
        line.wait_for_silence(now)
        assert line.ready_at(now, estop_pending=True) == now + QUIET or line.babbling
        now += MS
    return line, now


def test_a_line_that_talks_no_longer_than_the_limit_holds_an_estop_back_too() -> None:
    line = quiet_line()
    line.wait_for_silence(1.0)
    line.wait_for_silence(1.0 + BABBLE)
    assert line.ready_at(1.0 + BABBLE, estop_pending=True) == 1.0 + BABBLE + QUIET
    assert not line.babbling
    line.wait_for_silence(1.0 + BABBLE + MS)
    assert line.ready_at(1.0 + BABBLE + MS, estop_pending=True) <= 1.0 + BABBLE + MS
    assert line.babbling


def test_a_line_that_never_falls_quiet_lets_every_frame_of_an_estop_through_and_nothing_else() -> None:
    line, now = babbling(1.3)
    for _ in range(3):
        assert line.ready_at(now, estop_pending=False) > now
        assert ready(line, now, estop_pending=True) <= now
        line.send(FRAME, now, 0.0)
        line.wait_for_silence(now + MS)
        now += MS
    assert line.babbling


def test_when_it_was_quiet_it_babbles_no_more() -> None:
    line, now = babbling(1.3)
    assert ready(line, now + QUIET) <= now + QUIET
    assert not line.babbling
    line.wait_for_silence(3.0)
    assert line.ready_at(3.0, estop_pending=True) == 3.0 + QUIET


# What was handed over


def test_bytes_take_their_time_and_the_next_frame_queues_behind_those_that_are_leaving() -> None:
    line = quiet_line(baudrate=10_000)  # a byte takes 1 ms
    assert line.send(FRAME, 1.0, 0.0) == 1.0
    assert line.sent_by == pytest.approx(1.01)
    assert line.ready_at(1.0, estop_pending=False) <= 1.0
    assert line.send(FRAME, 1.001, 0.0) == pytest.approx(1.01)
    assert line.sent_by == pytest.approx(1.02)


def test_no_more_than_one_frame_waits_behind_the_one_that_is_leaving() -> None:
    line = quiet_line(baudrate=10_000)
    line.send(FRAME, 1.0, 0.0)
    line.send(FRAME, 1.0, 0.0)
    for estop_pending in (False, True):
        assert line.ready_at(1.0, estop_pending=estop_pending) == pytest.approx(1.01), (
            "then the first has left and the second begins to"
        )
    assert line.ready_at(1.0101, estop_pending=False) <= 1.0101


def test_bytes_that_arrive_meanwhile_let_no_third_frame_in() -> None:
    line = quiet_line(baudrate=10_000)
    line.send(FRAME, 1.0, 0.0)
    line.send(FRAME, 1.0, 0.0)
    line.wait_for_silence(1.0)
    assert line.ready_at(1.0, estop_pending=False) == pytest.approx(1.01)


def test_a_line_without_a_baud_rate_takes_no_time() -> None:
    line = quiet_line()
    line.send(FRAME, 1.0, 0.0)
    assert (line.sent_by, line.ready_at(1.0, estop_pending=False)) == (1.0, 1.0)


def test_the_silence_a_request_asks_for_follows_its_last_byte() -> None:
    line = quiet_line(baudrate=10_000)
    line.send(FRAME, 1.0, 0.5)
    assert line.ready_at(1.0, estop_pending=False) == pytest.approx(1.51)
    assert line.ready_at(1.52, estop_pending=False) <= 1.52
    line.send(FRAME, 2.0, 0.0)
    assert line.ready_at(2.0, estop_pending=False) <= 2.0, "once"


def test_the_silence_follows_the_answer_where_there_is_one() -> None:
    line = quiet_line(baudrate=10_000)
    line.send(FRAME, 1.0, 0.0)
    line.answered(1.1, 0.5)
    assert line.ready_at(1.1, estop_pending=False) == pytest.approx(1.6)


def test_an_answer_says_that_all_has_left_however_soon_it_comes() -> None:
    line = quiet_line(baudrate=10_000)
    line.send(FRAME, 1.0, 0.0)
    line.answered(1.002, 0.0)
    assert line.sent_by == 1.002
    assert line.send(FRAME, 1.002, 0.0) == 1.002
    line.answered(9.0, 0.0)
    assert line.sent_by == pytest.approx(1.012), "and no later than it did"


def test_a_gap_goes_before_each_frame_so_none_is_queued() -> None:
    line = quiet_line(baudrate=10_000, gap=0.004)
    assert line.send(FRAME, 1.0, 0.0) == 1.0
    assert line.ready_at(1.0, estop_pending=False) == pytest.approx(1.014)
    line.answered(1.05, 0.0)
    assert line.ready_at(1.05, estop_pending=False) == pytest.approx(1.054)
    line.send(FRAME, 1.054, 0.001)
    assert line.ready_at(1.054, estop_pending=False) == pytest.approx(1.068), "the longer of both"
    line.wait_for_silence(2.0)
    assert line.ready_at(2.0, estop_pending=False) == 2.004, "longer than the usual quiet"


# Echo


def test_our_own_bytes_are_taken_out_however_they_are_cut() -> None:
    echo = EchoFilter()
    echo.sent(b"abc")
    echo.sent(b"def")
    assert [echo.strip(piece) for piece in (b"a", b"bcd", b"efXY", b"Z")] == [b"", b"", b"XY", b"Z"]
    assert echo.collisions == 0


def test_other_bytes_where_our_own_are_due_are_a_collision_and_kept() -> None:
    echo = EchoFilter()
    echo.sent(b"abc")
    assert echo.strip(b"aXc") == b"aXc"
    assert echo.collisions == 1
    assert echo.strip(b"abc") == b"abc", "nothing is due any more"


def test_an_echo_that_never_comes_is_not_waited_for_without_end() -> None:
    echo = EchoFilter()
    echo.sent(bytes(ECHO_LIMIT))
    assert echo.collisions == 0
    echo.sent(b"a")
    assert echo.collisions == 1
    assert echo.strip(b"aX") == b"X"


def test_waiting_for_silence_forgets_the_echo_that_did_not_come() -> None:
    line = quiet_line()
    line.echo = EchoFilter()
    line.send(b"abc", 1.0, 0.0)
    assert line.echo.strip(b"a") == b""
    line.wait_for_silence(1.1)
    assert ready(line, 2.0) <= 2.0
    assert line.echo.strip(b"bc") == b"bc"
