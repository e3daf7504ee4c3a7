"""The runner: fences before doubt, retries where allowed, and an end for everything."""

from __future__ import annotations

from typing import Any

import pytest

from servobus.engine.health import FIRST_ALLOWANCE, MAX_ALLOWANCE
from servobus.engine.job import TRIES
from servobus.engine.stats import Counter
from servobus.errors import DeviceError, ReplyTimeout
from servobus.protocols.base import Plan, Request
from tests.engine.driven_engine import FENCE, Rig, ask, careful, three_reads
from tests.engine.toy_protocol import ANSWER, PING, READ, REFUSED, group_read, read, reply, shout, write

# The plain way


def test_a_request_is_sent_and_its_caller_gets_the_value() -> None:
    rig = Rig()
    results = rig.submit(read(1, 5))
    assert rig.engine.idle
    assert rig.answer(42) == ask(5)
    assert (results, rig.engine.idle, rig.next()) == ([42], True, b"")


def test_what_nobody_answers_is_done_when_it_is_sent() -> None:
    rig = Rig()
    results = rig.submit(shout(7))
    assert rig.next() == bytes((3, 7))
    assert results == [None]


def test_a_plan_keeps_the_line_from_its_first_frame_to_its_last() -> None:
    rig = Rig()
    results, other = rig.submit(plan=three_reads(), node=1), rig.submit(read(2, 99))
    assert [rig.answer(value) for value in (1, 2, 3, 4)] == [ask(10), ask(11), ask(12), ask(99)]
    assert (results, other) == ([[1, 2, 3]], [4])


def test_a_plan_that_fails_at_once_costs_nothing_and_the_next_goes_on() -> None:
    def refuses() -> Plan[None]:
        yield from ()
        raise DeviceError("no such thing")

    rig = Rig()
    results, other = rig.submit(plan=refuses(), node=1), rig.submit(read(2, 99))
    assert rig.answer(4) == ask(99)
    assert str(results[0]) == "arm: no such thing"
    assert other == [4]


def test_how_soon_a_node_answers_is_learned() -> None:
    rig = Rig()
    for _ in range(50):
        rig.submit(read(1))
        rig.submit(read(2))
        rig.hear(reply(1, READ, 0).frame, latency=0.030)
        rig.hear(reply(2, READ, 0).frame, latency=0.001)
    assert rig.node(1).reply_allowance_s > 0.030 > rig.node(2).reply_allowance_s


# Fences


def test_a_fence_goes_before_a_question_to_a_doubtful_node() -> None:
    rig = Rig()
    rig.doubt(1)
    results = rig.submit(read(1, 5))
    assert [rig.answer(), rig.answer(42)] == [FENCE, ask(5)]
    assert (results, rig.node(1).health, rig.stats.counts[Counter.FENCES]) == ([42], "online", 1)


def test_the_fence_looks_like_nothing_that_may_still_come() -> None:
    rig = Rig()
    rig.doubt(1, (PING | ANSWER, 0))
    rig.submit(read(1, 5))
    assert rig.answer() == bytes((PING, 1))


def test_another_node_needs_no_fence_nor_what_nobody_answers() -> None:
    rig = Rig()
    rig.doubt(1)
    rig.submit(read(2, 5))
    assert rig.answer() == ask(5)
    rig = Rig()
    rig.doubt(1)
    rig.submit(shout(6))
    assert rig.next() == bytes((3, 6))


def test_each_doubtful_node_of_a_group_is_fenced() -> None:
    rig = Rig()
    rig.doubt(1)
    rig.doubt(3)
    results = rig.submit(group_read(1, 2, 3))
    assert [rig.answer(), rig.answer(), rig.answer(9)] == [FENCE, FENCE, ask(0)]
    assert results == [{1: 9, 2: 9, 3: 9}]


def test_a_probe_is_its_own_fence() -> None:
    rig = Rig(online=False)
    assert rig.answer() == FENCE
    assert (rig.node(1).health, rig.stats.counts[Counter.FENCES]) == ("online", 1)


def test_an_unanswered_fence_costs_a_try_and_is_never_repeated_as_it_was() -> None:
    rig = Rig()
    rig.doubt(1)
    results = rig.submit(read(1, 5))
    assert [rig.miss(), rig.miss()] == [FENCE, bytes((PING, 1))]
    assert (results, rig.node(1).misses) == ([], 2)
    assert [rig.answer(), rig.answer(42)] == [bytes((PING, 2)), ask(5)]
    assert results == [42]


def test_a_node_that_answers_no_fence_goes_offline_and_its_caller_is_results() -> None:
    rig = Rig()
    rig.doubt(1)
    results = rig.submit(read(1, 5))
    for _ in range(3):
        rig.miss()
    (error,) = results
    assert isinstance(error, ReplyTimeout)
    assert (rig.node(1).health, rig.engine.idle) == ("offline", True)


def test_a_plan_is_results_of_the_fence_that_failed_and_goes_its_own_way() -> None:
    rig = Rig()
    rig.take_offline(1)
    results = rig.submit(plan=careful(), node=1, even_if_offline=True)
    rig.miss()
    assert rig.next() == bytes((3, 1))
    assert results == ["ReplyTimeout"]


# Retries


def test_an_idempotent_request_is_repeated_behind_a_fence_each_time() -> None:
    rig = Rig()
    results = rig.submit(read(1, 5))
    for attempt in range(TRIES):
        if attempt:
            assert rig.answer()[0] == PING
        assert rig.miss() == ask(5)
    (error,) = results
    assert isinstance(error, ReplyTimeout)
    assert f"no answer after {TRIES} tries" in str(error)
    assert (error.bus, error.raw) == ("arm", read(1, 5).frame)
    assert rig.stats.counts[Counter.RETRIES] == TRIES - 1


def test_a_retry_waits_until_the_other_nodes_had_their_turn() -> None:
    rig = Rig()
    results, second, other = rig.submit(read(1, 5)), rig.submit(read(1, 6)), rig.submit(read(2, 7))
    assert [rig.miss(), rig.answer()] == [ask(5), FENCE], "after a request a probe, for one is due now"
    assert [rig.answer(7), rig.answer(8), rig.answer(9)] == [ask(7), ask(5), ask(6)]
    assert (results, second, other) == ([8], [9], [7])


def test_a_plan_repeats_its_frame_and_keeps_the_line() -> None:
    rig = Rig()
    rig.submit(plan=three_reads(), node=1)
    rig.submit(read(2, 99))
    assert [rig.answer(), rig.miss(), rig.answer(), rig.answer(), rig.answer()] == [ask(10), ask(11), FENCE, ask(11), ask(12)]


@pytest.mark.parametrize(("request_", "traits"), [(read(1, 5, idempotent=False), {}), (read(1, 5), {"tries": 1})])
def test_a_request_that_is_not_idempotent_is_sent_once(request_: Request[Any], traits: dict[str, Any]) -> None:
    rig = Rig()
    results = rig.submit(request_, **traits)
    assert rig.miss() == ask(5)
    assert "after 1 try:" in str(results[0])
    assert rig.engine.idle
    assert rig.stats.counts[Counter.RETRIES] == 0


def test_an_offline_node_is_asked_once() -> None:
    rig = Rig()
    rig.take_offline(1)
    results = rig.submit(read(1, 5), even_if_offline=True)
    assert rig.miss() == FENCE
    assert isinstance(results[0], ReplyTimeout)
    assert rig.next() == b""


def test_a_request_whose_echo_came_is_asked_differently() -> None:
    rig = Rig()
    results = rig.submit(write(1, 5))
    assert rig.hear(write(1, 5).frame).echoes == 1
    assert rig.answer()[0] == PING
    assert rig.answer(5) == ask(5), "what was to be written is read"
    assert results == [5]


def test_a_rejected_window_is_a_miss_of_all_its_nodes() -> None:
    rig = Rig()
    results = rig.submit(read(1, 5))
    assert rig.hear(reply(1, READ, 42).frame, b"\x00").complete()
    assert (results, rig.node(1).health, rig.node(1).misses) == ([], "doubtful", 1)
    assert [rig.answer(), rig.answer(7)] == [FENCE, ask(5)]
    assert results == [7]


# Groups


def test_a_group_read_believes_who_answered_and_doubts_who_did_not() -> None:
    rig = Rig()
    before = rig.node(1).reply_allowance_s
    results = rig.submit(group_read(1, 2, 3))
    rig.hear(reply(1, READ, 10).frame, reply(3, READ, 30).frame, latency=MAX_ALLOWANCE)
    assert results == [{1: 10, 3: 30}]
    assert [rig.node(number).health for number in (1, 2, 3)] == ["online", "doubtful", "online"]
    assert rig.node(1).reply_allowance_s == before == FIRST_ALLOWANCE, "those who answered do not pay for the one who did not"


def test_a_group_read_nobody_answered_is_a_miss() -> None:
    rig = Rig()
    results = rig.submit(group_read(1, 2), tries=1)
    rig.hear()
    assert isinstance(results[0], ReplyTimeout)


def test_a_group_read_behind_which_stands_junk_is_not_believed() -> None:
    rig = Rig()
    results = rig.submit(group_read(1, 2), tries=1)
    rig.hear(reply(1, READ, 10).frame, reply(2, READ, 20).frame, b"\x00")
    assert isinstance(results[0], ReplyTimeout)
    assert [rig.node(number).health for number in (1, 2)] == ["doubtful", "doubtful"]


def test_a_group_that_must_be_whole_is_asked_again() -> None:
    rig = Rig()
    results = rig.submit(group_read(1, 2, partial=False))
    rig.hear(reply(1, READ, 10).frame)
    assert [rig.answer(), rig.answer(5)] == [FENCE, ask(0)]
    assert results == [{1: 5, 2: 5}]


@pytest.mark.parametrize("whole", [True, False])
def test_a_group_read_that_cannot_be_understood_ends_in_its_error(whole: bool) -> None:
    rig = Rig()
    results = rig.submit(group_read(1, 2))
    frames = [reply(1, READ, REFUSED).frame, reply(2, READ, 5).frame]
    rig.hear(*frames[: 2 if whole else 1])
    assert isinstance(results[0], DeviceError)
    assert rig.engine.idle


# Mistakes


def test_an_answer_that_says_no_ends_its_request_with_that() -> None:
    rig = Rig()
    results = rig.submit(read(1, 5))
    rig.answer(REFUSED)
    assert str(results[0]) == "arm: it says no"
    assert rig.node(1).health == "online", "it has answered"


def test_a_mistake_in_a_driver_ends_its_job_and_never_the_bus() -> None:
    def broken() -> Plan[None]:
        yield read(1, 1)
        raise KeyError("a mistake")

    rig = Rig()
    odd = read(2, 2)
    odd.parse = lambda replies: replies[7]  # type: ignore[method-assign]
    results, parsed, other = rig.submit(plan=broken(), node=1), rig.submit(odd), rig.submit(read(3, 3))
    assert [rig.answer(), rig.answer(), rig.answer(9)] == [ask(1), ask(2), ask(3)]
    assert [type(each[0]) for each in (results, parsed)] == [KeyError, IndexError]
    assert other == [9]
