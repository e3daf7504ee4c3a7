"""The parts of an SMS model beyond its register map, and which files are not a model."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from servobus.protocols.sms.model import SmsModel
from tests.protocols.sms.single_servo import FAMILIES, changed, model_of


def with_keys(**keys: Any) -> SmsModel:
    return SmsModel.model_validate({**model_of("sts").model_dump(), **keys})


@pytest.mark.parametrize(
    ("family", "ranges"),
    [
        (
            "sts",
            {
                "position": (-32767, 32767),
                "speed": (-32767, 32767),
                "acceleration": (0, 25_400),
                "torque_limit": (0, 100),
            },
        ),
        ("scs", {"position": (0, 1023), "speed": (0, 1000), "acceleration": (0, 0), "torque_limit": (0, 0)}),
        ("sms_cl", {"position": (-32767, 32767), "speed": (-32767, 32767), "acceleration": (0, 25_400), "torque_limit": (0, 0)}),
    ],
)
def test_the_ranges_of_goals(family: str, ranges: dict[str, tuple[float, float]]) -> None:
    assert model_of(family).goal_ranges == ranges


@pytest.mark.parametrize(("family", "feedback", "health"), [("sts", (40, 27), (40, 31)), ("scs", (40, 27), (40, 27))])
def test_blocks_are_read_whole(family: str, feedback: tuple[int, int], health: tuple[int, int]) -> None:
    model = model_of(family)
    assert model.block(*model.feedback) == feedback
    assert model.block(*model.health) == health


@pytest.mark.parametrize("family", FAMILIES)
def test_the_sentinel_shows_a_restart(family: str) -> None:
    """What enable() writes differs from what a restart leaves there, and the register can hold both."""
    model = model_of(family)
    register = model.registers[model.sentinel.name]
    assert model.sentinel.value != model.sentinel.reset
    assert register.memory == "ram"
    low, high = register.raw_range
    assert low <= model.sentinel.reset <= high
    assert low <= model.sentinel.value <= high
    assert (register.default or 0) == model.sentinel.reset


@pytest.mark.parametrize("family", FAMILIES)
def test_the_kinds_of_goals_are_those_of_its_modes(family: str) -> None:
    assert model_of(family).kinds == (("position",) if family == "scs" else ("position", "velocity"))
    assert with_keys(modes={"velocity": {}}).kinds == ("velocity",)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"goal": ["goal_position", "goal_speed", "goal_time"]}, "do not follow one another"),
        ({"goal": ["goal_position", "goal_time"]}, "at least 3 items"),
        ({"goal": ["goal_position", "goal_time", "speeed"]}, "speeed is named as a part, but the map has no such register"),
        ({"lock": "padlock"}, "padlock is named as a part"),
        ({"torque": "power"}, "power is named as a part"),
        ({"sentinel": {"name": "x", "value": 1, "reset": 0}}, "x is named as a part"),
        ({"modes": {"pwm": {"modus": 1}}}, "modus is named as a part"),
        ({"feedback": ("moving", "present_position")}, "moving comes after present_position"),
        ({"health": ("present_current", "present_position")}, "present_current comes after present_position"),
        ({"state": {"speed": "present_speed"}}, "state: position must be there"),
        ({"units": {}}, "units"),
        ({"units": {"deg": 0}}, "units.deg"),
        ({"steps_per_turn": 0}, "steps_per_turn"),
        ({"colour": "red"}, "colour"),
    ],
)
def test_an_unknown_model_is_refused(keys: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError) as caught:
        with_keys(**keys)
    assert message in str(caught.value)


@pytest.mark.parametrize("name", ["response_status_level", "min_angle_limit", "max_angle_limit"])
def test_registers_that_every_model_must_have(name: str) -> None:
    with pytest.raises(ValidationError, match=f"registers: {name} must be there"):
        changed("sts", **{name: None})


@pytest.mark.parametrize(
    ("register", "message"),
    [
        ({"address": 256}, "found 1 bytes at address 256; the last address is 255"),
        ({"address": 255, "size": 2}, "found 2 bytes at address 255"),
        ({"address": 254, "size": 2}, ""),
        ({"address": 200, "sign_bit": 8}, "found sign_bit 8; its 1 bytes have bits 0 to 7"),
        ({"address": 200, "sign_bit": 7}, ""),
        ({"address": 200, "maximum": 256}, "found values 0 to 256; it can hold 0 to 255"),
        ({"address": 200, "maximum": 255}, ""),
        ({"address": 200, "minimum": -1}, "found values -1 to 255; it can hold 0 to 255"),
        ({"address": 200, "sign_bit": 7, "minimum": -127}, ""),
        ({"address": 200, "sign_bit": 7, "minimum": -128}, "found values -128 to 127; it can hold -127 to 127"),
        ({"address": 200, "minimum": 5, "maximum": 4}, "found values 5 to 4"),
        ({"address": 200, "default": 255}, ""),
        ({"address": 200, "default": 256}, "found default 256; it can hold 0 to 255"),
    ],
)
def test_a_register_must_fit_the_memory_table(register: dict[str, Any], message: str) -> None:
    if not message:
        assert changed("sts", mine=register).registers["mine"].address == register["address"]
        return
    with pytest.raises(ValidationError) as caught:
        changed("sts", mine=register)
    assert message in str(caught.value)
