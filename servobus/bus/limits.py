"""Whether a goal may be sent at all: finite, inside the limits, not too fast, not too far. Pure; a refusal costs no byte.

`on_limit: reject` refuses what is outside, `on_limit: clamp` sends the nearest that is inside and says so.
"""

from __future__ import annotations

from dataclasses import replace

from servobus.errors import LimitError
from servobus.protocols.options import ServoOptions
from servobus.values import GOAL_NUMBERS, Goal, is_number, no_number


def check_goal(name: str, goal: Goal, options: ServoOptions, setpoint: float | None) -> Goal:
    """The goal to send: the same, or clamped where the servo says so. `setpoint` is the last position asked for or seen.
    Raises LimitError."""
    for field in GOAL_NUMBERS:
        value = getattr(goal, field)
        if value is None and field != "value":
            continue
        if not is_number(value):
            raise LimitError(no_number(field, value), servo=name)
        if field != "value" and (value < 0 or (value == 0 and field != "speed")):
            raise LimitError(f"{field}: {value:g} must be above 0", servo=name)
    if goal.speed is not None and goal.duration is not None:
        raise LimitError("give a speed or a duration, not both", servo=name)
    if goal.effort is not None and goal.effort > 100:
        raise LimitError(f"effort: {goal.effort:g} % is above 100 %", servo=name)
    if goal.kind == "velocity":
        return replace(goal, value=_within(name, "velocity", goal.value, _symmetric(options.max_speed), options))
    goal = replace(goal, value=_position(name, goal.value, options, setpoint))
    if goal.speed is not None:
        goal = replace(goal, speed=_within(name, "speed", goal.speed, _symmetric(options.max_speed), options))
    if goal.duration is not None and options.max_speed is not None and setpoint is not None:
        fastest = abs(goal.value - setpoint) / options.max_speed
        if goal.duration < fastest:
            if options.on_limit == "reject":
                reason = f"is too short for max_speed {options.max_speed:g}: give {fastest:.3g} s or more"
                raise LimitError(f"duration: {goal.duration:g} s {reason}", servo=name)
            goal = replace(goal, duration=fastest)
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


def _symmetric(greatest: float | None) -> tuple[float, float] | None:
    return None if greatest is None else (-greatest, greatest)
