"""Model files: the packaged ones hold what the vendor's memory tables say, and own ones extend them."""

from __future__ import annotations

from pathlib import Path

import pytest

from servobus.errors import ConfigError
from servobus.protocols.sms.load import find_model, merged, packaged_models, read_model

Fact = tuple[int, int, int | None, str]
"""Address, bytes, sign bit, memory."""
MAGNETIC: dict[str, Fact] = {
    "id": (5, 1, None, "eeprom"),
    "baud_rate": (6, 1, None, "eeprom"),
    "return_delay": (7, 1, None, "eeprom"),
    "response_status_level": (8, 1, None, "eeprom"),
    "min_angle_limit": (9, 2, None, "eeprom"),
    "max_angle_limit": (11, 2, None, "eeprom"),
    "max_temperature": (13, 1, None, "eeprom"),
    "max_torque": (16, 2, None, "eeprom"),
    "torque_enable": (40, 1, None, "ram"),
    "acceleration": (41, 1, None, "ram"),
    "goal_position": (42, 2, 15, "ram"),
    "goal_speed": (46, 2, 15, "ram"),
    "present_position": (56, 2, 15, "ram"),
    "present_speed": (58, 2, 15, "ram"),
    "present_load": (60, 2, 10, "ram"),
    "present_voltage": (62, 1, None, "ram"),
    "present_temperature": (63, 1, None, "ram"),
    "async_write_flag": (64, 1, None, "ram"),
    "moving": (66, 1, None, "ram"),
    "present_current": (69, 2, None, "ram"),
}
FACTS: dict[str, dict[str, Fact]] = {
    "sms": {**MAGNETIC, "lock": (55, 1, None, "ram"), "position_offset": (31, 2, 11, "eeprom"), "mode": (33, 1, None, "eeprom")},
    "sts": {**MAGNETIC, "lock": (55, 1, None, "ram"), "position_offset": (31, 2, 11, "eeprom"), "mode": (33, 1, None, "eeprom")},
    "sms_cl": {
        **{name: fact for name, fact in MAGNETIC.items() if name not in ("present_current",)},
        "lock": (48, 1, None, "ram"),
        "mode": (35, 1, None, "eeprom"),
    },
    "scs": {
        "id": (5, 1, None, "eeprom"),
        "min_angle_limit": (9, 2, None, "eeprom"),
        "max_angle_limit": (11, 2, None, "eeprom"),
        "torque_enable": (40, 1, None, "ram"),
        "goal_position": (42, 2, None, "ram"),
        "goal_time": (44, 2, None, "ram"),
        "lock": (48, 1, None, "ram"),
        "present_position": (56, 2, None, "ram"),
        "moving": (66, 1, None, "ram"),
    },
}
CASES = [(model, name, fact) for model, facts in FACTS.items() for name, fact in facts.items()]


@pytest.mark.parametrize(("model", "name", "fact"), CASES, ids=[f"{model}-{name}" for model, name, _ in CASES])
def test_registers_stand_where_the_tables_say(model: str, name: str, fact: Fact) -> None:
    register = packaged_models()[model].registers[name]
    assert (register.address, register.size, register.sign_bit, register.memory) == fact


@pytest.mark.parametrize(
    ("model", "order", "middle", "sync_read", "wheel"),
    [
        ("sms", "little", 2048, False, {"mode": 1}),
        ("sts", "little", 2048, True, {"mode": 1}),
        ("sms_cl", "little", 2048, False, {"mode": 1}),
        ("scs", "big", 512, False, {"min_angle_limit": 0, "max_angle_limit": 0}),
    ],
)
def test_what_differs_between_the_families(model: str, order: str, middle: int, sync_read: bool, wheel: dict[str, int]) -> None:
    found = packaged_models()[model]
    assert (found.byte_order, found.zero, found.sync_read) == (order, middle, sync_read)
    assert found.wheel is not None
    assert found.wheel.registers == wheel
    assert found.default_speed == 1000


def test_all_four_are_packaged() -> None:
    assert set(packaged_models()) == {"sms", "sms_cl", "sts", "scs"}


def test_names_and_files(tmp_path: Path) -> None:
    assert find_model("sts", tmp_path) is packaged_models()["sts"]
    with pytest.raises(ConfigError, match="model 'stx' is not known; there are scs, sms, sms_cl, sts"):
        find_model("stx", tmp_path)
    with pytest.raises(ConfigError, match="there is no such file"):
        find_model("mine.yaml", tmp_path)


def test_an_own_model_extends_a_packaged_one(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("extends: sts\nname: mine\ntitle: Mine\nregisters: {goal_speed: {maximum: 500}}\n")
    model = read_model(path)
    assert model.registers["goal_speed"].maximum == 500
    assert model.registers["goal_speed"].address == 46
    assert packaged_models()["sts"].registers["goal_speed"].maximum != 500


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("extends: none\nname: x\n", ":1:10: extends: is none of scs, sms, sms_cl, sts"),
        ("extends: sts\nregisters: {lock: {adress: 5}}\n", "did you mean address?"),
        ("extends: sts\nregisters: {lock: {address: -1}}\n", ":2:29: registers.lock.address: found -1"),
        ("extends: sts\ngoal: [goal_position, goal_speed, goal_time]\n", "do not stand one behind the other"),
        ("extends: sts\ntorque: power\n", "power is named as a part, but is no register of the map"),
        ("name: x\n", "the key title is missing"),
    ],
)
def test_mistakes_in_a_model_file(text: str, told: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        read_model(path)
    assert told in str(caught.value)


def test_merging() -> None:
    assert merged({"a": {"b": 1, "c": 2}, "d": [1, 2]}, {"a": {"b": 3}, "d": [9]}) == {"a": {"b": 3, "c": 2}, "d": [9]}
    assert merged(1, {"a": 1}) == {"a": 1}
