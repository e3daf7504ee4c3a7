"""How fast a servo travels to a goal."""

from __future__ import annotations

from typing import Any

import pytest

from servobus.errors import LimitError
from servobus.protocols.options import ServoOptions
from servobus.protocols.speed import goal_speed
from servobus.values import Goal, ServoGoal

MODEL_SPEED = 40.0


def speed_of(goal: Goal, start: float | None = 0.0, **options: Any) -> float:
    return goal_speed(ServoGoal("a", goal, start), ServoOptions.model_validate({"id": 1, **options}), MODEL_SPEED)


@pytest.mark.parametrize(
    ("speed", "options", "expected"),
    [
        (5.0, {"speed": 10.0, "max_speed": 20.0}, 5.0),
        (None, {"speed": 10.0, "max_speed": 20.0}, 10.0),
        (None, {"max_speed": 20.0}, 20.0),
        (None, {}, MODEL_SPEED),
        (0.0, {"allow_max_speed": True}, 0.0),
    ],
)
def test_the_first_speed_that_is_given_counts(speed: float | None, options: dict[str, Any], expected: float) -> None:
    assert speed_of(Goal("position", 10.0, speed=speed), **options) == expected


@pytest.mark.parametrize(
    ("duration", "start", "options", "expected"),
    [
        (2.0, 4.0, {}, 3.0),
        (2.0, 16.0, {}, 3.0),
        (0.1, 4.0, {"max_speed": 20.0}, 20.0),
        (2.0, 10.0, {"max_speed": 20.0}, 20.0),
        (2.0, 10.0, {}, MODEL_SPEED),
    ],
)
def test_a_duration_becomes_a_speed(duration: float, start: float, options: dict[str, Any], expected: float) -> None:
    assert speed_of(Goal("position", 10.0, duration=duration), start, **options) == expected


def test_speed_0_is_refused_unless_the_config_allows_it() -> None:
    with pytest.raises(LimitError, match="speed 0 means no limit: give a speed, or set allow_max_speed"):
        speed_of(Goal("position", 10.0, speed=0.0))


def test_a_duration_without_a_position_is_refused() -> None:
    with pytest.raises(LimitError, match="a duration needs the present position"):
        speed_of(Goal("position", 10.0, duration=1.0), None)
