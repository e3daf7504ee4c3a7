"""Goals of fingers in the fewest writes, their settings, and previews."""

from __future__ import annotations

from contextlib import suppress
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobus.errors import DeviceError, LimitError, NotSupported, ReplyTimeout
from servobus.protocols.base import Plan, Request, run_plan
from servobus.protocols.modbus.codec import Function
from servobus.protocols.roh.driver import RohDriver
from servobus.protocols.roh.options import CHANNELS
from servobus.protocols.roh.spans import Span, read_spans, write_spans
from servobus.values import ServoGoal, StopTarget
from tests.protocols.roh.bench import HAND, THREE, Bench, all_fingers, bus_options, goal, three_hands

TARGETS = {"legacy": 1125, "v1": 1135, "v2": 1135}


# The fewest writes


def test_six_fingers_are_one_write() -> None:
    bench = Bench().enable()
    goals = [goal(channel, 100 if channel == "thumb_rotation" else 0) for channel in CHANNELS]
    assert bench.move(*goals) == dict.fromkeys(CHANNELS, "acked")
    assert [request.frame.hex(" ") for request in bench.sent] == ["02 10 04 6f 00 06 0c" + " 00" * 10 + " ff ff 60 3e"]
    bench.after(2)
    assert [round(finger.position) for finger in bench.hand.fingers] == [0] * 5 + [65535]


def test_only_what_was_asked_for_is_written() -> None:
    bench = Bench().enable()
    assert len(bench.move(goal("index", 10), goal("middle", 20), goal("little", 30))) == 3
    assert bench.frames() == ["unit 2 WRITE 1136 to 1137 = 6554 13107", "unit 2 WRITE 1139 = 19660"]


@pytest.mark.parametrize(("limit", "writes"), [(6, 1), (5, 2), (3, 2), (2, 3), (1, 6)])
def test_writes_keep_to_what_the_line_carries(limit: int, writes: int) -> None:
    bench = Bench(max_write=limit).enable()
    bench.move(*all_fingers(100))
    assert len(bench.frames()) == writes
    assert max(len(request.frame) for request in bench.sent or [bench.driver.unused()]) <= 9 + 2 * limit


def test_degrees_and_percent_have_registers_of_their_own() -> None:
    servos = {**HAND, "index": {**HAND["index"], "unit": "deg"}}
    bench = Bench(servos).enable()
    results = bench.move(goal("thumb_bend", 50), goal("index", 150.5), goal("middle", 50))
    assert set(results.values()) == {"acked"}
    assert bench.frames() == ["unit 2 WRITE 1135 = 32768", "unit 2 WRITE 1137 = 32768", "unit 2 WRITE 1156 = 15050"]
    assert bench.after(3).read("index", "position") == pytest.approx(100 * (178.37 - 150.5) / 78.15, abs=0.01)
    assert bench.read("index", "angle") == pytest.approx(150.5, abs=0.02)
    assert bench.run(bench.driver.fence(2, [], bench.driver.nodes)), "an angle may read back a little otherwise"


@pytest.mark.parametrize("together", [True, False])
def test_a_goal_reaches_the_target_register_of_each_map_and_no_other(together: bool) -> None:
    """One number is a speed in one map and a target in another."""
    bench = three_hands().enable()
    for number, channel in enumerate(CHANNELS):
        names = [f"{name}_{channel}" for name in TARGETS]
        turns = bench.driver.plan_goals([goal(name, 100) for name in names], together=together, confirm=False)
        assert [turn.servos for turn in turns] == ([tuple(names)] if together else [(name,) for name in names])
        for turn in turns:
            assert set(bench.run(turn.plan).values()) == {"acked"}
        for hand, address in zip(bench.devices, TARGETS.values(), strict=True):
            assert hand.written[number:] == [(address + number, 65535)]


def test_pinned_maps_are_kept_apart_too() -> None:
    bench = Bench(THREE, units={2: {"model": "legacy"}, 3: {"model": "v1"}, 4: {"model": "v2"}}).enable()
    bench.move(*(goal(name, 100) for name in THREE))
    assert [hand.written for hand in bench.devices] == [
        [(first + number, 65535) for number in range(6)] for first in TARGETS.values()
    ]


def test_one_hand_that_does_not_answer_keeps_no_other() -> None:
    bench = three_hands().enable()
    bench.devices[1].dead = True
    results = bench.move(goal("legacy_index", 10), goal("v1_index", 10), goal("v2_index", 10), together=True)
    assert results["legacy_index"] == results["v2_index"] == "acked"
    error = results["v1_index"]
    assert isinstance(error, ReplyTimeout)
    assert error.servo == "v1_index"


# Speed, effort, duration


def test_a_speed_is_written_before_the_target_and_once() -> None:
    bench = Bench().enable()
    bench.move(goal("index", 100, speed=50), goal("middle", 100, speed=50))
    assert bench.frames() == ["unit 2 WRITE 1126 to 1127 = 32768 32768", "unit 2 WRITE 1136 to 1137 = 65535 65535"]
    bench.after(1)
    assert round(bench.hand.fingers[1].position) == 32768
    bench.move(goal("index", 0, speed=50))
    assert bench.frames() == ["unit 2 WRITE 1136 = 0"]
    bench.move(goal("index", 0))
    assert bench.frames() == ["unit 2 WRITE 1126 = 65534", "unit 2 WRITE 1136 = 0"]


def test_a_goal_without_speed_and_effort_has_those_of_the_config() -> None:
    servos = {
        "index": {**HAND["index"], "speed": 25, "max_speed": 80, "torque_limit": 50},
        "middle": {**HAND["middle"], "max_speed": 75},
    }
    bench = Bench(servos).enable()
    bench.move(goal("index", 10), goal("middle", 10))
    assert bench.frames() == ["unit 2 WRITE 1096 = 589", "unit 2 WRITE 1136 to 1137 = 6554 6554"]
    assert [bench.hand.peek("speed", channel) for channel in (1, 2)] == [16384, 49151], "since they were enabled"
    bench.move(goal("index", 10, effort=100))
    assert bench.frames() == ["unit 2 WRITE 1096 = 1178", "unit 2 WRITE 1136 = 6554"]


def test_a_duration_becomes_a_speed() -> None:
    bench = Bench().enable()
    bench.move(goal("index", 50, start=0.0, duration=1))
    assert bench.frames()[0] == "unit 2 WRITE 1126 = 32768"
    bench.move(goal("index", 50, start=50.0, duration=1))
    assert bench.frames()[0] == "unit 2 WRITE 1126 = 65534", "there already: any speed will do"
    bench.driver.check_goal(goal("index", 50, duration=1))
    error = bench.move(goal("index", 50, duration=1))["index"]
    assert isinstance(error, LimitError)
    assert "present position" in error.message


def test_degrees_a_second_become_positions_a_second() -> None:
    bench = Bench({"index": {**HAND["index"], "unit": "deg"}}).enable()
    bench.move(goal("index", 150, speed=78.15 / 2))
    assert bench.frames()[0] == "unit 2 WRITE 1126 = 32767"


def test_speeds_at_the_edge() -> None:
    bench = Bench({"index": {**HAND["index"], "allow_max_speed": True}, "middle": HAND["middle"]}).enable()
    for speed, raw in ((100, 65534), (0, 65534), (0.0001, 1)):
        changes = bench.driver.fingers["index"].wanted_settings(bench.driver.hands[2].map, goal("index", 1, speed=speed))
        assert changes == {"speed": raw, "current_limit": 1178}
    with pytest.raises(LimitError, match=r"speed 100.01 %/s is above the hand's maximum, 100"):
        bench.driver.check_goal(goal("index", 1, speed=100.01))
    with pytest.raises(LimitError, match="speed 0 means no limit"):
        bench.driver.check_goal(goal("middle", 1, speed=0))


def test_a_finger_whose_speed_was_refused_does_not_start() -> None:
    bench = Bench().enable()
    bench.hand.fails[1126] = 5
    results = bench.move(goal("index", 100, speed=50), goal("ring", 100, speed=50))
    assert isinstance(results["index"], DeviceError)
    assert results["ring"] == "acked"
    assert "unit 2 WRITE 1138 = 65535" in bench.frames()
    assert bench.hand.fingers[1].target == 0


def test_limits_and_speeds_are_taken_while_a_finger_is_enabled() -> None:
    bench = Bench({"index": HAND["index"]}).enable()
    assert bench.driver.use_options(bus_options({"index": {**HAND["index"], "speed": 40}}, poll={"feedback": 5}))
    bench.move(goal("index", 10))
    assert bench.frames() == ["unit 2 WRITE 1126 = 26214", "unit 2 WRITE 1136 = 6554"]
    for servos, keys in (({"ring": HAND["ring"]}, {}), ({"index": HAND["index"]}, {"units": {2: {"model": "v1"}}})):
        assert not bench.driver.use_options(bus_options(servos, **keys))


# What no finger does


@pytest.mark.parametrize("value", [0, 100])
def test_positions_at_the_edge(value: float) -> None:
    bench = Bench().enable()
    bench.driver.check_goal(goal("index", value))


@pytest.mark.parametrize(
    ("wanted", "error"),
    [
        (goal("index", -0.001), "position -0.001 is outside 0 to 100"),
        (goal("index", 100.001), "outside 0 to 100"),
        (goal("index", 1, kind="velocity"), "positions only"),
        (goal("index", 1, acceleration=1), "no register for it"),
    ],
)
def test_beyond_it(wanted: ServoGoal, error: str) -> None:
    bench = Bench().enable()
    with pytest.raises((LimitError, NotSupported), match=error):
        bench.driver.check_goal(wanted)
    result = bench.move(wanted, goal("ring", 50))
    assert isinstance(result["index"], (LimitError, NotSupported))
    assert result["ring"] == "acked"
    assert bench.hand.fingers[1].target == 0


@pytest.mark.parametrize(("value", "fine"), [(100.22, True), (178.37, True), (100.21, False), (178.38, False)])
def test_angles_beyond_the_fingers_range_are_refused(value: float, fine: bool) -> None:
    """The hand would silently go to its limit."""
    bench = Bench({"index": {**HAND["index"], "unit": "deg"}}).enable()
    if fine:
        bench.driver.check_goal(goal("index", value))
    else:
        with pytest.raises(LimitError, match=r"outside 100.22 to 178.37, the range of index"):
            bench.driver.check_goal(goal("index", value))


@given(st.dictionaries(st.sampled_from(CHANNELS), st.floats(0, 100), min_size=1), st.integers(1, 10))
def test_the_targets_hold_exactly_what_was_asked_for(wanted: dict[str, float], limit: int) -> None:
    bench = Bench(max_write=limit).enable()
    bench.move(*(goal(name, value) for name, value in wanted.items()))
    assert dict(bench.hand.written) == {1135 + list(HAND).index(name): round(value * 655.35) for name, value in wanted.items()}
    assert len(bench.hand.written) == len(wanted)


@given(st.sets(st.integers(1000, 1200), max_size=20), st.integers(1, 64))
def test_spans_hold_everything_and_fit(addresses: set[int], limit: int) -> None:
    for spans in (read_spans(addresses, limit), write_spans(addresses, limit)):
        assert all(any(span.contains(address) for span in spans) for address in addresses)
        assert all(span.count <= limit for span in spans)
        assert all(one.end <= other.start for one, other in pairwise(spans))
    assert sum(span.count for span in write_spans(addresses, limit)) == len(addresses)


def test_a_read_runs_over_strangers_only_where_that_is_cheaper() -> None:
    assert read_spans([1, 28], 64) == [Span(1, 28)]
    assert read_spans([1, 29], 64) == [Span(1, 1), Span(29, 1)]
    assert read_spans([1, 12], 12) == [Span(1, 12)]
    assert read_spans([1, 13], 12) == [Span(1, 1), Span(13, 1)]


# Previews and missing answers


def test_previews_are_the_writes_and_change_nothing() -> None:
    bench = Bench()
    fit = bench.driver.hands[2].fit
    for preview in (
        bench.driver.preview_goals(all_fingers(50)),
        bench.driver.preview_stop([StopTarget(channel, "hold", True, 0.0) for channel in CHANNELS]),
    ):
        assert [(request.frame[:7].hex(" "), len(request.frame)) for request in preview] == [("02 10 04 6f 00 06 0c", 21)]
    some = bench.driver.preview_goals([goal("index", 10), goal("middle", 20), goal("little", 30)])
    assert [len(request.frame) for request in some] == [13, 11]
    assert bench.driver.hands[2].fit is fit
    with pytest.raises(DeviceError, match="not asked yet"):
        bench.driver.check_goal(goal("index", 50))


def verbs(driver: RohDriver) -> dict[str, Plan[Any]]:
    """Plans that ask a hand for its map, or read what it holds."""
    (goals,) = driver.plan_goals(all_fingers(50), together=False, confirm=False)
    return {
        "identify": driver.identify("index"),
        "goals": goals.plan,
        "enable": driver.enable("index"),
        "write": driver.write_register("index", "beep_period", 0.5),
        "stop": driver.stop([StopTarget("index", "hold", True, 50.0)]),
        "command": driver.commissioning.command(2, "zero_force"),
    }


@pytest.mark.parametrize("registers", [[], [0x0200]])
@pytest.mark.parametrize("verb", ["identify", "goals", "enable", "write", "stop", "command"])
def test_an_empty_answer_opens_no_gate(verb: str, registers: list[int]) -> None:
    """Nothing is written before the map is known, whatever reply a plan gets."""
    driver = Bench().driver
    sent: list[int] = []

    def exchange(request: Request[Any]) -> list[int]:
        sent.append(request.frame[1])
        return registers

    with suppress(DeviceError):
        run_plan(verbs(driver)[verb], exchange)
    assert set(sent) == {Function.READ_HOLDING}
    with pytest.raises(DeviceError, match="nothing is written to it"):
        driver.check_goal(goal("index", 50))


def test_an_empty_answer_is_no_position() -> None:
    """A stop and an enable that read nothing write nothing."""
    bench = Bench()
    bench.run(bench.driver.identify("index"))
    sent: list[int] = []

    def exchange(request: Request[Any]) -> list[int]:
        sent.append(request.frame[1])
        return []

    with pytest.raises(DeviceError, match="incomplete"):
        run_plan(bench.driver.enable("index"), exchange)
    reports = run_plan(bench.driver.stop([StopTarget("index", "hold", True)]), exchange)
    assert (reports["index"].written, reports["index"].confirmed) == (False, False)
    assert set(sent) == {Function.READ_HOLDING}
