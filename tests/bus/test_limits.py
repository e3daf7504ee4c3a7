"""Limits: what is refused costs no byte, and what stands exactly on a limit passes."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from servobus.bus.limits import check_goal
from servobus.errors import LimitError
from servobus.protocols.options import ServoOptions
from servobus.values import Goal

PLAIN = ServoOptions(id=1)
NEXT = 1e-9
"""A little beyond."""


def options(**keys: Any) -> ServoOptions:
    return ServoOptions.model_validate({"id": 1, **keys})


def check(goal: Goal, setpoint: float | None = 0.0, **keys: Any) -> Goal:
    return check_goal("elbow", goal, options(**keys), setpoint)


def at(value: Any, **fields: Any) -> Goal:
    return Goal("position", value, **fields)


NO_NUMBERS: list[Any] = [math.nan, math.inf, -math.inf, True, False, "1", 10**400, -(10**5000), [1], 1j, "9" * 99]


def _kind(value: object) -> str:
    return type(value).__name__


@pytest.mark.parametrize("value", [*NO_NUMBERS, None], ids=_kind)
@pytest.mark.parametrize("on_limit", ["reject", "clamp"])
def test_what_is_no_finite_number_is_refused_and_never_clamped(value: object, on_limit: str) -> None:
    with pytest.raises(LimitError, match=r"elbow: value: .{1,50} is not a finite number"):
        check(at(value), on_limit=on_limit, limits=[-90, 90])


@pytest.mark.parametrize("value", NO_NUMBERS, ids=_kind)
@pytest.mark.parametrize("field", ["speed", "duration", "acceleration", "effort", "start_within"])
@pytest.mark.parametrize("kind", ["position", "velocity"])
def test_every_other_field_is_a_finite_number_or_absent(field: str, value: Any, kind: Any) -> None:
    with pytest.raises(LimitError, match=f"{field}: .{{1,50}} is not a finite number"):
        check(replace(Goal(kind, 1.0), **{field: value}))


@pytest.mark.parametrize("field", ["speed", "duration", "acceleration", "effort", "start_within"])
def test_every_other_field_is_above_zero(field: str) -> None:
    with pytest.raises(LimitError, match=f"{field}: -1 must be"):
        check(at(1.0, **{field: -1}))
    assert check(at(1.0, **{field: 1e-9}))


@pytest.mark.parametrize("field", ["duration", "acceleration", "effort", "start_within"])
def test_zero_is_refused_where_it_means_nothing(field: str) -> None:
    with pytest.raises(LimitError, match=f"{field}: 0 must be above 0"):
        check(at(1.0, **{field: 0}))


def test_speed_zero_is_for_the_driver_to_judge() -> None:
    assert check(at(1.0, speed=0)).speed == 0


def test_speed_and_duration_exclude_each_other() -> None:
    with pytest.raises(LimitError, match="not both"):
        check(at(1.0, speed=1.0, duration=1.0))


def test_effort_reaches_to_a_hundred_percent() -> None:
    assert check(at(1.0, effort=100)).effort == 100
    with pytest.raises(LimitError, match="above 100"):
        check(at(1.0, effort=100 + NEXT))


def test_without_limits_a_goal_stays_as_it_is() -> None:
    goal = at(1e6, speed=5.0, acceleration=3.0, effort=10, start_within=1.0)
    assert check_goal("elbow", goal, PLAIN, None) == goal
    wheel = Goal("velocity", -1e6)
    assert check_goal("elbow", wheel, PLAIN, None) == wheel


@pytest.mark.parametrize("edge", [-90, 90])
def test_a_position_on_its_limit_passes_and_one_beyond_does_not(edge: float) -> None:
    beyond = edge + math.copysign(NEXT, edge)
    assert check(at(edge), limits=[-90, 90]).value == edge
    with pytest.raises(LimitError, match=r"position .* is outside -90 to 90: nothing was sent"):
        check(at(beyond), limits=[-90, 90])
    assert check(at(beyond), limits=[-90, 90], on_limit="clamp").value == edge


@pytest.mark.parametrize("edge", [-7.0, 13.0])
def test_a_step_is_counted_from_the_setpoint(edge: float) -> None:
    beyond = edge + math.copysign(NEXT, edge - 3)
    assert check(at(edge), 3.0, max_step=10).value == edge
    with pytest.raises(LimitError, match="max_step 10 from 3"):
        check(at(beyond), 3.0, max_step=10)
    assert check(at(beyond), 3.0, max_step=10, on_limit="clamp").value == edge


def test_a_step_from_nowhere_is_not_limited() -> None:
    assert check(at(80.0), None, max_step=10).value == 80.0


def test_a_servo_outside_its_limits_is_clamped_towards_the_inside() -> None:
    assert check(at(0.0), -100.0, limits=[-90, 90], max_step=5, on_limit="clamp").value == -95.0


def test_limits_hold_before_the_step() -> None:
    assert check(at(200.0), 85.0, limits=[-90, 90], max_step=10, on_limit="clamp").value == 90


@pytest.mark.parametrize("kind", ["position", "velocity"])
def test_a_speed_on_its_limit_passes_and_one_beyond_does_not(kind: str) -> None:
    def of(speed: float) -> Goal:
        return at(1.0, speed=speed) if kind == "position" else Goal("velocity", speed)

    def speed_of(goal: Goal) -> float | None:
        return goal.speed if kind == "position" else goal.value

    assert speed_of(check(of(180.0), max_speed=180)) == 180.0
    with pytest.raises(LimitError, match="is outside -180 to 180"):
        check(of(180.0 + NEXT), max_speed=180)
    assert speed_of(check(of(999.0), max_speed=180, on_limit="clamp")) == 180.0


def test_a_wheel_turns_both_ways_no_faster_than_its_limit_and_knows_no_positions() -> None:
    assert check(Goal("velocity", -180.0), max_speed=180, limits=[-1, 1]).value == -180.0
    with pytest.raises(LimitError, match="velocity -181"):
        check(Goal("velocity", -181.0), max_speed=180)


def test_a_duration_that_needs_exactly_the_max_speed_passes() -> None:
    assert check(at(90.0, duration=0.5), max_speed=180).duration == 0.5
    with pytest.raises(LimitError, match=r"duration: 0.4 s is too short for max_speed 180: give 0.5 s or more"):
        check(at(90.0, duration=0.4), max_speed=180)
    assert check(at(90.0, duration=0.4), max_speed=180, on_limit="clamp").duration == 0.5


def test_a_duration_counts_the_way_that_is_left_after_clamping() -> None:
    assert check(at(360.0, duration=0.5), max_speed=180, limits=[-90, 90], on_limit="clamp") == at(90, duration=0.5)


def test_a_duration_is_not_checked_without_a_start_or_a_max_speed() -> None:
    assert check(at(90.0, duration=0.001), None, max_speed=180).duration == 0.001
    assert check(at(90.0, duration=0.001)).duration == 0.001
