"""Stops of fingers."""

from __future__ import annotations

from typing import Any

import pytest

from servobus.protocols.base import Request
from servobus.protocols.roh.options import CHANNELS
from servobus.values import StopTarget
from tests.protocols.roh.bench import Bench, all_fingers, goal, three_hands


def target(servo: str, *, kind: Any = "hold", enabled: bool = True, **how: Any) -> StopTarget:
    return StopTarget(servo, kind, enabled, **how)


READ_ALL = "unit 2 READ 1135 to 1150"


def test_hold_is_target_to_present() -> None:
    """Read, written, and read back twice: a position of a moment ago is where the finger was."""
    bench = Bench().enable()
    bench.move(*all_fingers(100))
    bench.after(0.25)
    bench.frames()
    reports = bench.run(bench.driver.stop([target(name, position=24.0) for name in CHANNELS]))
    assert [(report.action, report.written, report.confirmed) for report in reports.values()] == [("hold", True, True)] * 6
    assert bench.frames() == [READ_ALL, "unit 2 WRITE 1135 to 1140 =" + " 16384" * 6, READ_ALL, READ_ALL]
    assert bench.run(bench.driver.fence(2, [], bench.driver.nodes)), "a stop is no restart"
    bench.after(2)
    assert {round(finger.position) for finger in bench.hand.fingers} == {16384}


def test_what_was_not_enabled_is_left_alone() -> None:
    bench = Bench().enable("index")
    reports = bench.run(bench.driver.stop([target("index", position=0.0), target("ring", enabled=False)]))
    assert reports["ring"].action == "none"
    read = "unit 2 READ 1136 to 1146"
    assert bench.frames() == [read, "unit 2 WRITE 1136 = 0", read, read, *["unit 2 READ 1138 to 1148"] * 2]


def test_what_another_program_moves_is_stopped_too() -> None:
    """A finger that was not enabled may be on its way all the same: from a program that was killed, say."""
    bench = Bench().enable("index")
    bench.move(goal("index", 100, speed=20))
    reports = bench.after(1).run(bench.driver.stop([target("index", enabled=False)]))
    assert (reports["index"].action, reports["index"].written, reports["index"].confirmed) == ("hold", True, True)
    assert bench.after(5).hand.fingers[1].position < 0.3 * 65535


def test_an_exit_leaves_alone_what_moves_after_a_restart() -> None:
    bench = Bench().enable("index")
    bench.move(goal("index", 100, speed=20))
    bench.frames()
    report = bench.run(bench.driver.stop([target("index", enabled=False, leave_alone=True)]))["index"]
    assert (report.action, report.written, report.confirmed, bench.frames()) == ("none", False, True, [])


def test_what_is_not_known_to_rest_is_not_confirmed() -> None:
    bench = Bench().enable("index")
    report = bench.run(bench.driver.stop([target("index", enabled=False, reachable=False)]))["index"]
    assert (report.action, report.written, report.confirmed) == ("none", False, False)


def test_where_limp_was_wanted_it_holds_and_says_so() -> None:
    bench = Bench().enable()
    reports = bench.run(bench.driver.stop([target("index", kind="limp"), target("ring")]))
    assert "no torque command" in reports["index"].detail
    assert "no torque command" in bench.run(bench.driver.disable("ring")).detail


@pytest.mark.parametrize("reachable", [True, False])
def test_a_finger_on_its_way_is_sent_where_it_is_taken_to_be_if_its_hand_is_silent(reachable: bool) -> None:
    """One that rested is sent nothing: if the hand has restarted, it would travel there."""
    bench = three_hands().enable()
    bench.move(goal("legacy_index", 90))
    bench.frames()
    bench.loses = lambda request: request.node == 2
    gone = [
        target("legacy_index", position=50.0, reachable=reachable),
        target("legacy_ring", position=0.2, reachable=reachable),
        target("legacy_little", reachable=reachable),
        target("v1_index", position=0.0),
    ]
    reports = bench.run(bench.driver.stop(gone))
    written = [frame for frame in bench.frames() if "WRITE" in frame]
    assert written == ["unit 3 WRITE 1136 = 0", *["unit 2 WRITE 1126 = 32768"] * 2]
    assert [(report.written, report.confirmed) for report in reports.values()] == [
        (True, False), (False, False), (False, False), (True, True),
    ]  # fmt: skip
    assert list(reports) == ["legacy_index", "legacy_ring", "legacy_little", "v1_index"]
    assert bench.driver.blind_stop(gone[0]) == (), "never a position again and again"


def test_a_stop_is_confirmed_only_when_the_finger_rests() -> None:
    """The reply to a write repeats address and count (ROH Modbus, 3.3): it tells nothing of what the finger does."""
    bench = Bench().enable()
    bench.move(goal("index", 100, speed=20))
    bench.after(1).hand.ignores_targets = True
    reports = bench.run(bench.driver.stop([target("index"), target("ring")]))
    assert (reports["index"].written, reports["index"].confirmed, reports["ring"].confirmed) == (True, False, True)
    assert "its target reads 100 after 20 was written" in reports["index"].detail
    bench.hand.ignores_targets = False
    assert bench.run(bench.driver.stop([target("index")]))["index"].confirmed


def test_a_finger_that_holds_its_target_and_travels_on_is_not_confirmed() -> None:
    bench = Bench().enable("index")
    bench.hand.fingers[1].speed = 0

    def travel(request: Request[Any]) -> bool:
        bench.hand.fingers[1].position += 200
        return False

    bench.loses = travel
    report = bench.run(bench.driver.stop([target("index")]))["index"]
    assert (report.written, report.confirmed) == (True, False)
    assert "it still moves: it was read at" in report.detail


@pytest.mark.parametrize("altered", [65535, 40000])
def test_one_altered_reading_moves_no_finger_that_is_stopped(altered: int) -> None:
    bench = Bench().enable("index")
    bench.altered = [(1146, altered)]
    assert bench.run(bench.driver.stop([target("index")]))["index"].confirmed
    assert bench.hand.written == [(1136, 0)]


def test_a_stop_that_fails_says_what_was_written() -> None:
    bench = Bench().enable()
    asked = iter(range(100))
    bench.loses = lambda request: request.frame[1] == 3 and next(asked) > 0
    reports = bench.run(bench.driver.stop([target("index", position=0.0)]))
    assert (reports["index"].written, reports["index"].confirmed) == (True, False)
    assert "not read back" in reports["index"].detail
    bench.loses = lambda request: False
    bench.hand.state = "calibration"
    reports = bench.run(bench.driver.stop([target("index", position=0.0)]))
    assert (reports["index"].written, reports["index"].confirmed) == (False, False)
    assert "waits for its calibration" in reports["index"].detail


@pytest.mark.parametrize("self_test", [0, 1])
def test_a_hand_that_has_restarted_is_sent_nowhere(self_test: int) -> None:
    bench = Bench().enable("index")
    bench.move(goal("index", 60))
    bench.after(2).hand.poke("self_test", 0, self_test)
    bench.hand.reboot(bench.now)
    stood = bench.after(10).hand.fingers[1].position
    bench.run(bench.driver.stop([target("index", position=60.0)]))
    assert bench.after(5).hand.fingers[1].position == stood


def test_disable_holds_a_finger_that_moves() -> None:
    """A hand has no torque command: left alone, the finger would go to its target."""
    bench = Bench().enable("index")
    bench.move(goal("index", 100, speed=20))
    bench.after(1)
    report = bench.run(bench.driver.disable("index"))
    assert (report.action, report.written, report.confirmed) == ("hold", True, True)
    assert bench.after(5).hand.fingers[1].position == pytest.approx(0.2 * 65535, rel=0.05)
    bench.frames()
    assert bench.run(bench.driver.disable("index")).action == "none"
    assert bench.frames() == ["unit 2 READ 1136 to 1146"] * 2
