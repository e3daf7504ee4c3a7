"""Stops of fingers."""

from __future__ import annotations

from typing import Any

from servobus.protocols.roh.options import CHANNELS
from servobus.values import StopTarget
from tests.protocols.roh.bench import Bench, all_fingers, three_hands


def target(servo: str, *, kind: Any = "hold", enabled: bool = True, **how: Any) -> StopTarget:
    return StopTarget(servo, kind, enabled, **how)


def test_hold_is_target_to_present() -> None:
    bench = Bench().enable()
    bench.move(*all_fingers(100))
    bench.after(0.25)
    bench.frames()
    reports = bench.run(bench.driver.stop([target(name, position=20.0) for name in CHANNELS]))
    assert [(report.action, report.written, report.confirmed) for report in reports.values()] == [("hold", True, True)] * 6
    at_once, where, again = bench.frames()
    assert at_once == "unit 2 WRITE 1135 to 1140 =" + " 13107" * 6
    assert where == "unit 2 READ 1145 to 1150"
    assert again == "unit 2 WRITE 1135 to 1140 =" + " 16384" * 6
    assert bench.run(bench.driver.fence(2, [], bench.driver.nodes)), "a stop is no restart"


def test_what_was_not_enabled_is_left_alone() -> None:
    bench = Bench().enable("index")
    reports = bench.run(bench.driver.stop([target("index"), target("ring", enabled=False)]))
    assert reports["ring"].action == "none"
    assert bench.frames() == ["unit 2 READ 1146", "unit 2 WRITE 1136 = 0"]


def test_where_limp_was_wanted_it_holds_and_says_so() -> None:
    bench = Bench().enable()
    reports = bench.run(bench.driver.stop([target("index", kind="limp"), target("ring")]))
    assert "no torque command" in reports["index"].detail
    assert "no torque command" in bench.run(bench.driver.disable("ring")).detail


def test_a_silent_hand_is_sent_its_last_positions_twice() -> None:
    bench = three_hands().enable()
    gone = [
        target("legacy_index", position=50.0, reachable=False),
        target("legacy_ring", position=200.0, reachable=False),
        target("v1_index", position=50.0),
    ]
    reports = bench.run(bench.driver.stop(gone))
    assert bench.frames()[-2:] == ["unit 2 WRITE 1126 = 32768"] * 2
    assert (reports["legacy_index"].written, reports["legacy_index"].confirmed) == (True, False)
    assert (reports["legacy_ring"].written, reports["legacy_ring"].confirmed) == (False, False)
    assert reports["v1_index"].confirmed
    assert list(reports) == ["legacy_index", "legacy_ring", "v1_index"]


def test_a_stop_that_fails_says_what_was_written() -> None:
    bench = Bench().enable()
    bench.loses = lambda request: request.frame[1] == 3
    reports = bench.run(bench.driver.stop([target("index", position=0.0), target("ring")]))
    assert (reports["index"].written, reports["index"].confirmed) == (True, False)
    assert (reports["ring"].written, reports["ring"].confirmed) == (False, False)
    bench.loses = lambda request: False
    bench.hand.state = "calibration"
    reports = bench.run(bench.driver.stop([target("index")]))
    assert "waits for its calibration" in reports["index"].detail
