"""Abort codes: each code of KST RS422, 3.9, in either byte order, becomes its error."""

from __future__ import annotations

from typing import Literal

import pytest

from servobus.errors import DeviceError, NotSupported
from servobus.protocols.kst import aborts
from servobus.protocols.kst.aborts import ABORTS, ADVICE, AbortReader, abort_text, decode, error_class

SEED = """
0503 0000	Toggle bit not alternated
0504 0000	SDO protocol timed out
0504 0001	Client/server command specifier not valid or unknown
0504 0002	Invalid block size (block mode only)
0504 0003	Invalid sequence number (block mode only)
0504 0004	CRC error (block mode only)
0504 0005	Out of memory
0601 0000	Unsupported access to an object
0601 0001	Attempt to read a write only object
0601 0002	Attempt to write a read only object
0602 0000	Object does not exist in the object dictionary
0604 0041	Object cannot be mapped to the PDO
0604 0042	The number and length of the objects to be mapped would exceed PDO length
0604 0043	General parameter incompatibility reason
0604 0047	General internal incompatibility in the device
0606 0000	Access failed due to a hardware error
0607 0010	Data type does not match, length of service parameter does not match
0607 0012	Data type does not match, length of service parameter too high
0607 0013	Data type does not match, length of service parameter too low
0609 0011	Sub-index does not exist
0609 0030	Value range of parameter exceeded (only for write access)
0609 0031	Value of parameter written too high
0609 0032	Value of parameter written too low
0609 0036	Maximum value is less than minimum value
0800 0000	General error
0800 0020	Data cannot be transferred or stored to the application
0800 0021	Data cannot be transferred or stored to the application because of local control
0800 0022	Data cannot be transferred or stored to the application because of the present device state
0800 0023	Object dictionary dynamic generation fails or no object dictionary is present
"""
CODES = {int(line[:9].replace(" ", ""), 16): line[10:] for line in SEED.strip().splitlines()}
KINDS: dict[int, type[DeviceError]] = {
    0x05040000: aborts.DeviceTimeout,
    0x06010000: aborts.AccessRefused,
    0x06010001: aborts.AccessRefused,
    0x06010002: aborts.AccessRefused,
    0x06020000: aborts.UnknownObject,
    0x06090011: aborts.UnknownObject,
    0x06070010: aborts.BadLength,
    0x06070012: aborts.BadLength,
    0x06070013: aborts.BadLength,
    0x06090030: aborts.OutOfRange,
    0x06090031: aborts.OutOfRange,
    0x06090032: aborts.OutOfRange,
    0x06060000: aborts.HardwareFault,
    0x08000021: aborts.WrongState,
    0x08000022: aborts.WrongState,
}
"""All others are a plain DeviceError."""


def test_the_table_is_the_specification_s_and_two_newer_ones() -> None:
    assert len(CODES) == 29
    assert {code: text for code, text in ABORTS.items() if code in CODES} == CODES
    assert ABORTS.keys() - CODES.keys() == {0x060A0023, 0x08000024}


@pytest.mark.parametrize("code", ABORTS)
@pytest.mark.parametrize("order", ["big", "little"])
def test_every_code_in_either_order(code: int, order: Literal["big", "little"]) -> None:
    """KST RS422, 3.9: the order of the code's four bytes is not stated."""
    data = code.to_bytes(4, order)
    reader = AbortReader()
    error = reader.error(7, "set position", data + bytes(4), raw=b"frame")
    assert type(error) is KINDS.get(code, DeviceError) is error_class(code)
    assert (error.code, error.raw) == (code, b"frame")
    assert f"set position was refused: {code >> 16:04X} {code & 0xFFFF:04X} {ABORTS[code]}; {ADVICE[type(error)]}" == str(error)
    assert reader.learned == ("be" if order == "big" else "le")


def test_no_code_is_another_one_read_in_another_order() -> None:
    for code in ABORTS:
        data = code.to_bytes(4, "big")
        others = {bytes(data[at] for at in order) for order in ((3, 2, 1, 0), (2, 3, 0, 1), (1, 0, 3, 2))} - {data}
        assert not {int.from_bytes(other, "big") for other in others} & ABORTS.keys()


def test_an_unknown_code_is_read_in_the_order_that_was_learned() -> None:
    reader = AbortReader()
    assert reader.code(b"\1\2\3\4") == 0x01020304
    assert reader.learned is None
    reader.code(b"\x30\x00\x09\x06")
    assert reader.code(b"\1\2\3\4") == 0x04030201
    reader.code(b"\x06\x09\x00\x30")
    assert reader.code(b"\1\2\3\4") == 0x01020304


def test_a_set_order_is_not_doubted() -> None:
    assert AbortReader("be").code(b"\x30\x00\x09\x06\0\0\0\0") == 0x30000906
    assert AbortReader("le").code(b"\x30\x00\x09\x06\0\0\0\0") == 0x06090030
    assert decode(b"\1\2\3\4", "le") == (0x04030201, None)


def test_an_unknown_code_is_shown_as_its_bytes() -> None:
    error = AbortReader().error(7, "save", b"\x01\x02\x03\x04\0\0\0\0")
    assert abort_text(0x01020304, b"\1\2\3\4") == "unknown abort code, bytes 01 02 03 04"
    assert "unknown abort code, bytes 01 02 03 04" in str(error)
    assert (type(error), error.code) == (DeviceError, 0x01020304)


def test_a_hardware_fault_latches_for_its_node_and_nothing_else_does() -> None:
    reader = AbortReader()
    for node, code in enumerate(ABORTS):
        reader.error(node, "read position", code.to_bytes(4, "big"))
    assert reader.faulty == {list(ABORTS).index(0x06060000)}


def test_refused_access_is_not_supported_as_well() -> None:
    error = AbortReader().error(1, "read status", b"\x06\x01\x00\x00")
    assert isinstance(error, NotSupported)
    assert error.exit_status == 2
