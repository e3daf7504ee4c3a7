"""Abort codes of error replies (KST RS422, 3.9): their texts, the error that each becomes, and the order of their four bytes.

The document prints a code as two 16-bit numbers and does not say which byte comes first. No known code is another one with its
bytes reversed, so with `auto` a code that is known in only one order tells the order. Until then it is big-endian, as printed.
"""

from __future__ import annotations

from typing import Any, Literal, TypeAlias

from servobus.errors import DeviceError, NotSupported

Order: TypeAlias = Literal["be", "le"]
CODE_SIZE = 4

ABORTS: dict[int, str] = {
    0x05030000: "Toggle bit not alternated",
    0x05040000: "SDO protocol timed out",
    0x05040001: "Client/server command specifier not valid or unknown",
    0x05040002: "Invalid block size (block mode only)",
    0x05040003: "Invalid sequence number (block mode only)",
    0x05040004: "CRC error (block mode only)",
    0x05040005: "Out of memory",
    0x06010000: "Unsupported access to an object",
    0x06010001: "Attempt to read a write only object",
    0x06010002: "Attempt to write a read only object",
    0x06020000: "Object does not exist in the object dictionary",
    0x06040041: "Object cannot be mapped to the PDO",
    0x06040042: "The number and length of the objects to be mapped would exceed PDO length",
    0x06040043: "General parameter incompatibility reason",
    0x06040047: "General internal incompatibility in the device",
    0x06060000: "Access failed due to a hardware error",
    0x06070010: "Data type does not match, length of service parameter does not match",
    0x06070012: "Data type does not match, length of service parameter too high",
    0x06070013: "Data type does not match, length of service parameter too low",
    0x06090011: "Sub-index does not exist",
    0x06090030: "Value range of parameter exceeded (only for write access)",
    0x06090031: "Value of parameter written too high",
    0x06090032: "Value of parameter written too low",
    0x06090036: "Maximum value is less than minimum value",
    0x08000000: "General error",
    0x08000020: "Data cannot be transferred or stored to the application",
    0x08000021: "Data cannot be transferred or stored to the application because of local control",
    0x08000022: "Data cannot be transferred or stored to the application because of the present device state",
    0x08000023: "Object dictionary dynamic generation fails or no object dictionary is present",
    # Newer editions of CiA 301 have these two; the KST document does not.
    0x060A0023: "Resource not available",
    0x08000024: "No data available",
}


class DeviceTimeout(DeviceError):
    """The servo reports an internal timeout (0504 0000). A read may be repeated."""


class AccessRefused(DeviceError, NotSupported):
    """The servo does not allow this value to be read or written (0601)."""


class UnknownObject(DeviceError):
    """The servo does not have what was asked for (0602, 0609 0011)."""


class BadLength(DeviceError):
    """The servo expects another length (0607)."""


class OutOfRange(DeviceError):
    """The value is outside the servo's range (0609 0030 to 0032)."""


class HardwareFault(DeviceError):
    """The servo's hardware has failed (0606). It latches: goals are refused until the servo is enabled again."""


class WrongState(DeviceError):
    """The servo refuses because of local control or its present state (0800 0021, 0800 0022)."""


BY_CODE: dict[int, type[DeviceError]] = {
    0x05040000: DeviceTimeout,
    0x06090011: UnknownObject,
    0x06090030: OutOfRange,
    0x06090031: OutOfRange,
    0x06090032: OutOfRange,
    0x08000021: WrongState,
    0x08000022: WrongState,
}
BY_GROUP: dict[int, type[DeviceError]] = {
    0x0601: AccessRefused,
    0x0602: UnknownObject,
    0x0606: HardwareFault,
    0x0607: BadLength,
}
"""By the upper 16 bits of a code. A code that is in neither table becomes a plain DeviceError."""

ADVICE: dict[type[DeviceError], str] = {
    DeviceError: "read its status and its firmware version",
    DeviceTimeout: "try again; if it happens again, check the servo's load and supply",
    AccessRefused: "this servo does not offer that command",
    UnknownObject: "its firmware does not know that: read its version",
    BadLength: "its firmware may use a newer protocol: read its version",
    OutOfRange: "compare the value with the servo's range (range_deg)",
    HardwareFault: "check the servo, then enable it again",
    WrongState: "read its status, and try again when that has changed",
}


def error_class(code: int) -> type[DeviceError]:
    """Return the error that an abort code is raised as."""
    return BY_CODE.get(code) or BY_GROUP.get(code >> 16) or DeviceError


def abort_text(code: int, data: bytes) -> str:
    """Return `0609 0030 Value range ...`, or the four bytes where the code is unknown."""
    text = ABORTS.get(code)
    return f"{code >> 16:04X} {code & 0xFFFF:04X} {text}" if text else f"unknown abort code, bytes {data.hex(' ')}"


def decode(data: bytes, order: Order | None) -> tuple[int, Order | None]:
    """Return the code in four bytes, and the order in which it is a known code. `order` is used if it is known in neither."""
    big, little = int.from_bytes(data, "big"), int.from_bytes(data, "little")
    if big in ABORTS:
        return big, "be"
    if little in ABORTS:
        return little, "le"
    return (little if order == "le" else big), None


class AbortReader:
    """Turns the error replies of a bus into errors. Remembers the byte order, and which nodes reported a hardware fault."""

    def __init__(self, order: Literal["auto", "be", "le"] = "auto") -> None:
        self.learned: Order | None = None if order == "auto" else order
        """The byte order; None until a known code has arrived."""
        self.faulty: set[int] = set()
        """Nodes whose hardware fault is latched."""
        self._auto = order == "auto"

    def code(self, data: bytes) -> int:
        """Return the code in the first four bytes of `data`."""
        data = data[:CODE_SIZE]
        if not self._auto:
            return int.from_bytes(data, "little" if self.learned == "le" else "big")
        code, order = decode(data, self.learned)
        self.learned = order or self.learned
        return code

    def error(self, node: int, command: str, data: bytes, **context: Any) -> DeviceError:
        """Return the error for a node's error reply to a command. `context`: attributes of the error."""
        code = self.code(data)
        kind = error_class(code)
        if kind is HardwareFault:
            self.faulty.add(node)
        return kind(f"{command} was refused: {abort_text(code, data[:CODE_SIZE])}; {ADVICE[kind]}", code=code, **context)
