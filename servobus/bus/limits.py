"""Whether a goal may be sent at all: finite, inside the limits, not too fast, not too far. Pure; a refusal costs no byte.

`on_limit: reject` refuses what is outside, `on_limit: clamp` sends the nearest that is inside and says so.
"""

from __future__ import annotations

from dataclasses import replace

from servobus.errors import LimitError
from servobus.protocols.options import ServoOptions
from servobus.values import GOAL_NUMBERS, Goal, is_number, no_number

GOAL_DETAILS = GOAL_NUMBERS[1:]
"""The numbers beside the value, which may be None."""


def check_goal(name: str, goal: Goal, options: ServoOptions, setpoint: float | None) -> Goal:
    """Return the goal to send: the same object, or a copy that is clamped where the servo's options say so.

    `setpoint` is the last position that was asked for or read. Raises LimitError.
    """
    if not is_number(goal.value):
        raise LimitError(no_number("value", goal.value), servo=name)
    plain = goal.speed is goal.duration is goal.acceleration is goal.effort is goal.start_within is None
    if not plain:
        _check_details(name, goal)
    if goal.kind == "velocity":
        value = _within(name, "velocity", goal.value, _symmetric(options.max_speed), options)
    else:
        value = _position(name, goal.value, options, setpoint)
    if value != goal.value:  # a copy of a goal costs as much as all these checks
        goal = replace(goal, value=value)
    return goal if plain or goal.kind == "velocity" else _limit_speed(name, goal, options, setpoint)


def _check_details(name: str, goal: Goal) -> None:
    """Check everything beside the value. Raises LimitError."""
    for field in GOAL_DETAILS:
        value = getattr(goal, field)
        if value is None:
            continue
        if not is_number(value):
            raise LimitError(no_number(field, value), servo=name)
        if value < 0 or (value == 0 and field != "speed"):
            raise LimitError(f"{field}: {value:g} must be above 0", servo=name)
    if goal.speed is not None and goal.duration is not None:
        raise LimitError("give a speed or a duration, not both", servo=name)
    if goal.effort is not None and goal.effort > 100:
        raise LimitError(f"effort: {goal.effort:g} % is above 100 %", servo=name)


def _limit_speed(name: str, goal: Goal, options: ServoOptions, setpoint: float | None) -> Goal:
    """Return the position goal with a speed, or a duration, that keeps to `max_speed`. Raises LimitError."""
    if goal.speed is not None:
        speed = _within(name, "speed", goal.speed, _symmetric(options.max_speed), options)
        return goal if speed == goal.speed else replace(goal, speed=speed)
    if goal.duration is not None and options.max_speed is not None and setpoint is not None:
        fastest = abs(goal.value - setpoint) / options.max_speed
        if goal.duration < fastest:
            if options.on_limit == "reject":
                reason = f"is too short for max_speed {options.max_speed:g}: give {fastest:.3g} s or more"
                raise LimitError(f"duration: {goal.duration:g} s {reason}", servo=name)
            return replace(goal, duration=fastest)
    return goal


def _position(name: str, value: float, options: ServoOptions, setpoint: float | None) -> float:
    value = _within(name, "position", value, options.limits, options)
    if options.max_step is None or setpoint is None:
        return value
    step = (setpoint - options.max_step, setpoint + options.max_step)
    return _within(name, "position", value, step, options, why=f" (max_step {options.max_step:g} from {setpoint:g})")


def _within(
    name: str, what: str, value: float, limits: tuple[float, float] | None, options: ServoOptions, *, why: str = ""
) -> float:
    if limits is None or limits[0] <= value <= limits[1]:
        return value
    if options.on_limit == "reject":
        raise LimitError(f"{what} {value:g} is outside {limits[0]:g} to {limits[1]:g}{why}: nothing was sent", servo=name)
    return min(max(value, limits[0]), limits[1])


def _symmetric(limit: float | None) -> tuple[float, float] | None:
    return None if limit is None else (-limit, limit)
