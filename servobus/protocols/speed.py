"""How fast a servo travels to a goal: the one rule of every protocol.

The speed is the first of these that is given: the goal's own, the servo's `speed`, its `max_speed`, the model's default. A
duration becomes a speed by the distance, at most `max_speed`. Speed 0 means "no limit" on the wire, so a goal may name it only
where the config sets `allow_max_speed`.
"""

from __future__ import annotations

from servobus.errors import LimitError
from servobus.protocols.options import ServoOptions
from servobus.values import ServoGoal


def default_speed(options: ServoOptions, model_speed: float) -> float:
    """Return the speed (unit/s) of a goal that names none; `model_speed` is the model's default in the same unit."""
    return options.speed or options.max_speed or model_speed


def goal_speed(goal: ServoGoal, options: ServoOptions, model_speed: float) -> float:
    """Return the speed (unit/s) on the way to a position; 0: no limit. Raises LimitError."""
    if goal.goal.duration is not None:
        return duration_speed(goal, options) or default_speed(options, model_speed)
    speed = goal.goal.speed
    if speed is None:
        return default_speed(options, model_speed)
    if speed == 0 and not options.allow_max_speed:
        raise LimitError("speed 0 means no limit: give a speed, or set allow_max_speed", servo=goal.servo)
    return speed


def duration_speed(goal: ServoGoal, options: ServoOptions) -> float:
    """Return the speed (unit/s) that covers the distance in the goal's duration; 0: it is there already. Raises LimitError.

    `max_speed` bounds it, because the servo may be farther away now than when the goal was checked.
    """
    assert goal.goal.duration is not None
    if goal.start is None:
        raise LimitError("a duration needs the present position, and it is not known: read the servo first", servo=goal.servo)
    speed = abs(goal.goal.value - goal.start) / goal.goal.duration
    return speed if options.max_speed is None else min(speed, options.max_speed)
