"""Registers and models: raw integers, bytes and physical values, at the edges of what a register holds."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from servobus.errors import LimitError, NotSupported, UnknownName
from servobus.protocols.model import Register, ServoModel

SIGNED = Register(name="goal", address=42, size=2, sign_bit=15)
SHORT = Register(name="load", address=60, size=2, sign_bit=10, scale=0.1)
PLAIN = Register(name="limit", address=48, size=2, minimum=1, maximum=1000, scale=0.1)
CODES = Register(name="baud_rate", address=6, values={0: 1_000_000, 4: 115_200, 9: "factory"})


@pytest.mark.parametrize(
    ("register", "raw", "little"),
    [
        (SIGNED, 0, "0000"),
        (SIGNED, 1, "0100"),
        (SIGNED, -1, "0180"),
        (SIGNED, 32767, "ff7f"),
        (SIGNED, -32767, "ffff"),
        (SHORT, 1023, "ff03"),
        (SHORT, -1023, "ff07"),
        (PLAIN, 1, "0100"),
        (PLAIN, 1000, "e803"),
    ],
)
def test_bytes_of_raw_values(register: Register, raw: int, little: str) -> None:
    data = bytes.fromhex(little)
    assert register.encode(raw, "little") == data
    assert register.encode(raw, "big") == data[::-1]
    assert register.decode(data, "little") == raw
    assert register.decode(data[::-1], "big") == raw


@pytest.mark.parametrize(
    ("register", "raw"), [(SIGNED, 32768), (SIGNED, -32768), (SHORT, 1024), (PLAIN, 0), (PLAIN, 1001), (CODES, 256)]
)
def test_one_beyond_the_edge_is_refused(register: Register, raw: int) -> None:
    with pytest.raises(LimitError, match=f"{register.name}: raw value {raw} is outside"):
        register.encode(raw, "little")


def test_minus_zero_is_zero() -> None:
    assert SIGNED.decode(b"\x00\x80", "little") == 0


@given(st.integers(-32767, 32767), st.sampled_from(["little", "big"]))
def test_what_is_encoded_is_decoded(raw: int, order: str) -> None:
    assert SIGNED.decode(SIGNED.encode(raw, order), order) == raw  # type: ignore[arg-type]


def test_physical_values() -> None:
    assert PLAIN.to_physical(605) == 60.5
    assert PLAIN.to_raw(60.5) == 605
    assert SIGNED.to_physical(-7) == -7
    assert CODES.to_physical(4) == 115_200
    assert CODES.to_physical(5) == 5, "a code without a meaning is shown as it is"
    assert CODES.to_raw(115_200) == 4
    assert CODES.to_raw("factory") == 9


@pytest.mark.parametrize("value", [math.nan, math.inf, True, "60", None])
def test_what_is_no_number_is_refused(value: object) -> None:
    with pytest.raises(LimitError, match="is not a finite number"):
        PLAIN.to_raw(value)


def test_a_value_without_a_code_is_refused() -> None:
    with pytest.raises(LimitError, match="9600 is not one of 1000000, 115200, factory"):
        CODES.to_raw(9600)


MODEL = {
    "name": "toy",
    "title": "Toy",
    "units": {"deg": 0.1},
    "status_bits": {0: "voltage", 2: "temperature"},
    "registers": {
        "position": {"address": 56, "access": "r", "aliases": ["where"]},
        "command": {"address": 60, "access": "w"},
        "limit": {"address": 48},
    },
}


def test_registers_by_name_and_alias() -> None:
    model = ServoModel.model_validate(MODEL)
    assert model.register("where") is model.register("position")
    assert model.readable("limit").address == model.writable("limit").address == 48
    with pytest.raises(UnknownName, match="toy has no register 'wher'; it has command, limit, position"):
        model.register("wher")
    with pytest.raises(NotSupported, match="can only be read"):
        model.writable("where")
    with pytest.raises(NotSupported, match="can only be written"):
        model.readable("command")
    assert model.goal_ranges == {}


@pytest.mark.parametrize(
    ("status", "names"), [(None, ()), (0, ()), (1, ("voltage",)), (5, ("voltage", "temperature")), (8, ("bit 3",))]
)
def test_names_of_faults(status: int | None, names: tuple[str, ...]) -> None:
    assert ServoModel.model_validate(MODEL).fault_names(status) == names


def test_one_name_stands_for_one_register() -> None:
    registers = {**MODEL["registers"], "load": {"address": 1, "aliases": ["position"]}}  # type: ignore[dict-item]
    with pytest.raises(ValidationError, match="the name position means both position and load"):
        ServoModel.model_validate({**MODEL, "registers": registers})
    with pytest.raises(ValidationError, match="registers"):
        ServoModel.model_validate({**MODEL, "registers": {"a": 7}})
    with pytest.raises(ValidationError, match="registers"):
        ServoModel.model_validate({**MODEL, "registers": 7})
