"""The packaged model files match the memory tables of the vendor."""

from __future__ import annotations

from typing import Literal

import pytest

from servobus.errors import LimitError
from servobus.protocols.model import Register
from servobus.protocols.sms.model import packaged_models

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
    "present_current": (69, 2, 15, "ram"),
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
def test_registers_have_the_addresses_of_the_tables(model: str, name: str, fact: Fact) -> None:
    register = packaged_models()[model].registers[name]
    assert (register.address, register.size, register.sign_bit, register.memory) == fact


def pairs(*addresses: int) -> dict[int, int]:
    return dict.fromkeys(addresses, 2)


def singles(*spans: range) -> dict[int, int]:
    return {address: 1 for span in spans for address in span}


TABLES: dict[str, dict[int, int]] = {
    "sms": singles(
        range(9), range(13, 16), range(18, 28), range(30, 31), range(33, 42), range(55, 56), range(62, 67), range(80, 87)
    )
    | pairs(9, 11, 16, 28, 31, 42, 44, 46, 48, 56, 58, 60, 67, 69),
    "sms_cl": singles(range(9), range(13, 16), range(18, 28), range(35, 36), range(40, 42), range(48, 49), range(62, 67))
    | pairs(9, 11, 16, 33, 36, 42, 44, 46, 56, 58, 60, 67, 69),
    "scs": singles(
        range(7), range(8, 9), range(13, 16), range(18, 23), range(26, 28), range(37, 41), range(48, 49), range(62, 67)
    )
    | pairs(9, 11, 16, 24, 42, 44, 46, 56, 58, 60, 69),
}
TABLES["sts"] = TABLES["sms"]
"""Every address of the memory tables  and its bytes."""
READ_ONLY = {*range(5), *range(56, 71), *range(80, 87)}


@pytest.mark.parametrize("model", TABLES)
def test_the_whole_memory_table_is_there(model: str) -> None:
    registers = [register for name, register in packaged_models()[model].registers.items() if name != "model_number"]
    assert sorted((register.address, register.size) for register in registers) == sorted(TABLES[model].items())


@pytest.mark.parametrize("model", TABLES)
def test_registers_that_can_only_be_read(model: str) -> None:
    for register in packaged_models()[model].registers.values():
        assert register.access == ("r" if register.address in READ_ONLY else "rw"), register.name


@pytest.mark.parametrize("model", TABLES)
def test_eeprom_ends_before_the_torque_switch(model: str) -> None:
    for register in packaged_models()[model].registers.values():
        assert register.memory == ("eeprom" if register.address < 40 or register.address >= 80 else "ram"), register.name


REGISTERS = [(model.byte_order, register) for model in packaged_models().values() for register in model.registers.values()]


@pytest.mark.parametrize(("order", "register"), REGISTERS, ids=lambda value: getattr(value, "name", value))
def test_every_register_holds_its_edges(order: Literal["little", "big"], register: Register) -> None:
    low, high = register.raw_range
    for raw in {low, high, max(low, 0)}:
        assert register.decode(register.encode(raw, order), order) == raw
    for raw in (low - 1, high + 1):
        with pytest.raises(LimitError, match=f"{register.name}: raw value {raw} is outside"):
            register.encode(raw, order)


BAUD_RATES = [1_000_000, 500_000, 250_000, 128_000, 115_200, 76_800, 57_600, 38_400, 19_200, 14_400, 9_600, 4_800]
SPANS = [
    ("sms", "return_delay", (0, 253)),
    ("sts", "return_delay", (0, 254)),
    ("sms", "min_angle_limit", (0, 4094)),
    ("sms", "max_angle_limit", (0, 4095)),
    ("scs", "max_angle_limit", (0, 1023)),
    ("sms", "cw_dead_band", (0, 16)),
    ("sts", "cw_dead_band", (0, 32)),
    ("sms", "angle_resolution", (1, 128)),
    ("sts", "angle_resolution", (1, 3)),
    ("sts", "position_offset", (-2047, 2047)),
    ("sts", "goal_position", (-32767, 32767)),
    ("sms_cl", "goal_speed", (-32767, 32767)),
    ("sts", "goal_time", (-1000, 1000)),
    ("scs", "goal_position", (0, 1023)),
    ("scs", "goal_time", (0, 9999)),
    ("scs", "goal_speed", (0, 1000)),
    ("scs", "min_startup_torque", (0, 1000)),
    ("sms", "min_startup_torque", (0, 254)),
]
PHYSICAL = [
    ("sts", "present_voltage", 74, 7.4),
    ("sts", "present_load", -1000, -100.0),
    ("sts", "present_current", 100, 0.65),
    ("sts", "present_current", -40, -0.26),
    ("sts", "present_temperature", 41, 41),
    ("sts", "return_delay", 250, 0.0005),
    ("sts", "protection_time", 200, 2.0),
    ("sts", "torque_limit", 1000, 100.0),
    ("sts", "acceleration", 254, 25_400),
    ("sts", "integral_limit", 2, 8),
    ("scs", "goal_time", 9999, 9.999),
]


@pytest.mark.parametrize(("model", "name", "span"), SPANS, ids=str)
def test_the_range_of_a_write(model: str, name: str, span: tuple[int, int]) -> None:
    assert packaged_models()[model].registers[name].raw_range == span


@pytest.mark.parametrize(("model", "name", "raw", "physical"), PHYSICAL, ids=str)
def test_scales(model: str, name: str, raw: int, physical: float) -> None:
    register = packaged_models()[model].registers[name]
    assert register.to_physical(raw) == physical
    assert register.to_raw(physical) == raw


@pytest.mark.parametrize("model", TABLES)
def test_codes_of_baud_rates_are_the_vendors(model: str) -> None:
    register = packaged_models()[model].registers["baud_rate"]
    assert [register.to_physical(code) for code in range(12)] == BAUD_RATES
    assert register.raw_range == (0, 7)


@pytest.mark.parametrize(
    ("model", "number", "product"),
    [
        ("sts", 777, "STS3215"),
        ("sts", 521, "STS3032"),
        ("sts", 2825, "STS3250"),
        ("scs", 1284, "SCS0009"),
        ("scs", 1295, "SCS15"),
        ("sms", 10248, "SM40BLHV"),
        ("sms", 11272, "SM85BLHV/SM8512BL"),
        ("sms_cl", 6, "SMxx-360M"),
    ],
)
def test_model_numbers(model: str, number: int, product: str) -> None:
    assert packaged_models()[model].model_numbers[number] == product


@pytest.mark.parametrize(
    ("model", "status", "names"),
    [
        ("sts", 0x2F, ("voltage", "encoder", "temperature", "current", "overload")),
        ("scs", 0x25, ("voltage", "temperature", "overload")),
    ],
)
def test_names_of_health_bits(model: str, status: int, names: tuple[str, ...]) -> None:
    assert packaged_models()[model].fault_names(status) == names


@pytest.mark.parametrize(
    ("model", "order", "middle", "sync_read", "modes"),
    [
        ("sms", "little", 2048, False, ["position", "velocity", "pwm", "step"]),
        ("sts", "little", 2048, True, ["position", "velocity", "pwm", "step"]),
        ("sms_cl", "little", 2048, False, ["position", "velocity", "pwm"]),
        ("scs", "big", 512, False, ["motor", "position"]),
    ],
)
def test_differences_between_the_families(model: str, order: str, middle: int, sync_read: bool, modes: list[str]) -> None:
    loaded = packaged_models()[model]
    assert (loaded.byte_order, loaded.zero, loaded.sync_read) == (order, middle, sync_read)
    assert list(loaded.modes) == modes
    assert loaded.default_speed == 1000


def test_all_four_are_packaged() -> None:
    assert set(packaged_models()) == {"sms", "sms_cl", "sts", "scs"}
