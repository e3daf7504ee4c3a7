"""The keys of a line of hands, and the register maps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from servobus.errors import ConfigError, LimitError, UnknownName
from servobus.protocols.base import LineTraits
from servobus.protocols.roh import DEFINITION
from servobus.protocols.roh.model import FILES, RohModel, load_models, packaged_models
from servobus.protocols.roh.options import CHANNELS
from tests.protocols.roh.bench import HAND, bus_options

INDEX = HAND["index"]


def one(**keys: Any) -> dict[str, dict[str, Any]]:
    return {"index": {**INDEX, **keys}}


@pytest.mark.parametrize("kind", ["on_estop", "on_exit", "on_lost_client"])
def test_no_finger_goes_limp(kind: str) -> None:
    with pytest.raises(ValidationError, match="no torque command, and its fingers cannot be made limp"):
        bus_options(one(**{kind: "limp"}))
    assert bus_options(one(**{kind: "hold"})).servos["index"].on_exit == "hold"


@pytest.mark.parametrize(
    ("keys", "bus", "why"),
    [
        ({"acceleration": 1}, {}, "no register for it"),
        ({"channel": "wrist"}, {}, "thumb_bend"),
        ({"unit": "rad"}, {}, "'%' or 'deg'"),
        ({"model": "v1"}, {}, "finger"),
        ({"id": 0}, {}, "greater than or equal to 1"),
        ({"id": 248}, {}, "less than or equal to 247"),
        ({}, {"units": {3: {"model": "v1"}}}, "no servo has the id 3; there are 2"),
        ({}, {"units": {2: {"model": "v3"}}}, "legacy"),
        ({}, {"single_write": "single", "echo": "auto"}, "set echo to off or on"),
        ({}, {"max_read": 126}, "less than or equal to 125"),
        ({}, {"max_write": 124}, "less than or equal to 123"),
    ],
)
def test_what_does_not_fit_is_refused(keys: dict[str, Any], bus: dict[str, Any], why: str) -> None:
    with pytest.raises(ValidationError, match=why):
        bus_options(one(**keys), **bus)


@pytest.mark.parametrize("unit", [1, 247])
def test_units_at_the_edge(unit: int) -> None:
    assert bus_options(one(id=unit)).servos["index"].id == unit


def test_a_finger_is_unique_by_unit_and_channel() -> None:
    options = bus_options({**HAND, "other": {"id": 3, "channel": "index"}})
    assert len({servo.key for servo in options.servos.values()}) == 7


def test_defaults() -> None:
    options = bus_options({}, units={9: {"model": "v1"}})
    assert (options.baudrate, options.map_of(9), options.map_of(2)) == (115_200, "v1", "auto")
    assert options.limits(LineTraits()) == (64, 64)
    assert options.limits(LineTraits(max_read=12, max_write=10)) == (12, 10)
    asked = bus_options({}, max_read=100, max_write=5)
    assert asked.limits(LineTraits()) == (100, 5)
    assert asked.limits(LineTraits(max_read=12, max_write=10)) == (12, 5)


@pytest.mark.parametrize(
    ("keys", "fine"),
    [
        ({"limits": [100.22, 178.37]}, True),
        ({"limits": [100.21, 178.37]}, False),
        ({"limits": [100.22, 178.38]}, False),
        ({"park_pose": 178.37}, True),
        ({"park_pose": 180.0}, False),
        ({"direction": -1, "limits": [-178.37, -100.22]}, True),
    ],
)
def test_limits_in_degrees_are_what_the_finger_reaches(keys: dict[str, Any], fine: bool) -> None:
    options = bus_options(one(unit="deg", **keys))
    if fine:
        assert set(load_models(options, Path())) == {"legacy", "v1", "v2", "finger"}
    else:
        with pytest.raises(ConfigError, match=r"outside 100.22 to 178.37, the range of index"):
            load_models(options, Path())


def test_scan() -> None:
    assert DEFINITION.baudrates[0] == 115_200
    assert {9_600, 460_800} <= set(DEFINITION.baudrates)
    assert (DEFINITION.scan_ids[0], DEFINITION.scan_ids[-1]) == (1, 247)


# Maps

PLACES = {
    "protocol_version": (None, 1000, 1000),
    "fw_version": (1000, 1001, 1001),
    "fw_revision": (1001, 1002, 1002),
    "hw_version": (1002, 1003, 1003),
    "boot_version": (1003, 1004, 1004),
    "sub_exception": (1004, 1006, 1006),
    "node_id": (1005, 1005, 1005),
    "battery_voltage": (1006, 1007, 1007),
    "self_test": (1007, 1008, 1008),
    "beep_switch": (1008, 1009, 1009),
    "beep_period": (1009, 1010, 1010),
    "button_press_cnt": (1010, 1011, 1011),
    "recalibrate": (1011, 1012, 1012),
    "start_init": (None, 1013, 1013),
    "reset": (None, 1014, 1014),
    "power_off": (None, 1015, 1015),
    "reset_force": (None, None, 1016),
    "cali_end": (1020, 1020, 1020),
    "cali_start": (1030, 1030, 1030),
    "cali_thumb_pos": (1040, 1040, 1040),
    "finger_p": (1045, 1045, 1045),
    "finger_i": (1055, 1055, 1055),
    "finger_d": (1065, 1065, 1065),
    "finger_g": (1075, 1075, 1075),
    "status": (1165, 1085, 1085),
    "current_limit": (1085, 1095, 1095),
    "current": (1095, 1105, 1105),
    "force_limit": (1105, 1115, None),
    "force_target": (None, None, 1115),
    "force": (1110, 1120, 1175),
    "speed": (1115, 1125, 1125),
    "pos_target": (1125, 1135, 1135),
    "pos": (1135, 1145, 1145),
    "angle_target": (1145, 1155, 1155),
    "angle": (1155, 1165, 1165),
    "stall_speed": (None, 1175, 1185),
    "stall_current": (None, 1185, 1195),
    "stop_after_period": (None, 1195, 1205),
    "retry_after_period": (None, 1205, 1215),
    "force_p": (None, None, 1225),
    "force_g": (None, None, 1255),
    "manu_data": (None, 1215, 1265),
    "speed_ctrl_brake_distance": (None, 1231, 1281),
    "speed_ctrl_accel_distance": (None, 1232, 1282),
    "pid_speed_ratio": (None, 1233, 1283),
    "force_ex": (None, None, 2000),
}
"""The reference's tables 1.2 and 1.3: legacy, v1, v2."""


@pytest.mark.parametrize("name", PLACES)
def test_where_registers_are(name: str) -> None:
    for model, address in zip(packaged_models().values(), PLACES[name], strict=True):
        if address is None:
            with pytest.raises(UnknownName):
                model.named(name)
        else:
            assert model.named(name).address == address


def test_what_registers_are() -> None:
    v1, v2 = packaged_models()["v1"], packaged_models()["v2"]
    assert (v1.named("beep_period").access, v1.named("status").access, v1.named("speed").access) == ("w", "r", "rw")
    assert (v1.named("beep_switch").memory, v1.named("speed").memory) == ("eeprom", "ram")
    assert (v1.named("node_id").default, v1.named("speed").default, v1.named("force_limit").default) == (2, 65535, 15000)
    assert [v2.named("force_ex").address_of(channel) for channel in range(6)] == [2000, 2100, 2200, 2300, 2400, 2500]
    assert v2.named("force_ex").length_of(5) == 28
    assert set(v2.angles) == set(CHANNELS)
    guarded = {register.name for register in v2.registers.values() if register.guarded}
    assert guarded == {"node_id", "recalibrate", "start_init", "reset", "power_off", "reset_force"}


@pytest.mark.parametrize(("raw", "word"), [(-32768, 0x8000), (-1, 0xFFFF), (0, 0), (32767, 0x7FFF)])
def test_angles_are_twos_complement_in_the_later_maps(raw: int, word: int) -> None:
    register = packaged_models()["v1"].named("angle_target")
    assert (register.to_word(raw), register.from_word(word)) == (word, raw)
    assert packaged_models()["legacy"].named("angle_target").from_word(0xFFFF) == 65535


@pytest.mark.parametrize("raw", [-32769, 32768])
def test_beyond_it(raw: int) -> None:
    with pytest.raises(LimitError, match="outside -32768 to 32767"):
        packaged_models()["v1"].named("angle_target").to_word(raw)


def test_a_map_that_lacks_a_part_is_refused(tmp_path: Path) -> None:
    data = packaged_models()["v1"].model_dump()
    del data["registers"]["speed"]
    with pytest.raises(ValidationError, match="a map has fw_version"):
        RohModel.model_validate(data)
    file = tmp_path / "bad.yaml"
    file.write_text("name: bad\n")
    with pytest.raises(ConfigError, match=r"bad.yaml:1"):
        FILES.read(file)


def test_which_maps_fit_what_a_hand_says() -> None:
    fits = {
        registers: [name for name, model in packaged_models().items() if model.fits(registers)]
        for registers in ((0x0100, 0x0301), (0x0200, 0x0301), (0x0300, 68), (0x0100, 0x0201), (0x0100,), (0x0400, 0x0301))
    }
    assert list(fits.values()) == [["v1"], ["v2"], ["legacy"], [], ["v1"], []]
    assert packaged_models()["v1"].goal_ranges["torque_limit"] == (0.0, 100.0)
