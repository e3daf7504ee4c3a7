"""Modbus-RTU frames (ROH Modbus, 1 and 3): unit, function, data, CRC-16 with its low byte first.

RTU has no header, and ends a frame by silence, which a codec cannot see. So the codec predicts a frame's length from its function
and byte count, and accepts the frame if its CRC is right. Requests and replies have different lengths, so there is a table for
each end of the line. The master's table also has its own requests, because some lines echo them.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from enum import IntEnum
from random import Random
from typing import Literal, NamedTuple

from servobus.protocols.stream import StreamCodec, decode_single

BROADCAST = 0
MAX_UNIT = 247
MAX_READ = 125
"""Registers of one read, so that the frame has at most 256 bytes."""
MAX_WRITE = 123
REFUSED = 0x80
"""Set in the function of an exception."""
CRC_SIZE = 2
READ_SIZE = WRITE_SIZE = 8
"""Bytes of a read request, of a single write in both directions, and of the reply to a write of several registers."""
EXCEPTION_SIZE = 5
MULTIPLE_OVERHEAD = 9
"""Bytes of a write of several registers, without their values."""
REPLY_OVERHEAD = 5
"""Bytes of a reply with registers, without their values."""


class Function(IntEnum):
    """The functions of ROH Modbus, 3.1 to 3.3."""

    READ_HOLDING = 0x03
    WRITE_SINGLE = 0x06
    WRITE_MULTIPLE = 0x10


NAMES = {Function.READ_HOLDING: "READ", Function.WRITE_SINGLE: "WRITE ONE", Function.WRITE_MULTIPLE: "WRITE"}


class Frame(NamedTuple):
    """One frame in either direction. `data`: the bytes between function and CRC."""

    unit: int
    function: int
    data: bytes
    frame: bytes

    @property
    def node(self) -> int:
        return self.unit

    @property
    def status(self) -> None:
        """Modbus has no health byte."""

    @property
    def key(self) -> Hashable:
        """What tells this reply from others. The reply to a read names the number of its bytes, and no address."""
        return reply_key(self.function, self.data[:1] if self.function == Function.READ_HOLDING else self.data[:4])


def reply_key(function: int, repeated: bytes) -> tuple[int, bytes]:
    """Return what tells the replies of one unit apart. `repeated`: the part of the request that the reply repeats."""
    return (function, repeated)


def _crc_of(byte: int) -> int:
    for _ in range(8):
        byte = byte >> 1 ^ (0xA001 if byte & 1 else 0)
    return byte


TABLE = tuple(_crc_of(byte) for byte in range(256))


def crc16(data: bytes) -> int:
    """Return the checksum: polynomial 0xA001, start value 0xFFFF."""
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ TABLE[(crc ^ byte) & 0xFF]
    return crc


def encode(unit: int, function: int, data: bytes) -> bytes:
    """Return the frame's bytes. Raises ValueError for a unit that cannot be addressed."""
    if not 0 <= unit <= MAX_UNIT:
        raise ValueError(f"unit {unit} is outside 1 to {MAX_UNIT} (or {BROADCAST} for all)")
    head = bytes((unit, function)) + data
    return head + crc16(head).to_bytes(CRC_SIZE, "little")


def unpack(data: bytes) -> list[int]:
    """Return the registers in these bytes, high byte first."""
    return [data[at] << 8 | data[at + 1] for at in range(0, len(data) - 1, 2)]


def pack(values: Sequence[int]) -> bytes:
    """Return the bytes of these registers, high byte first."""
    return b"".join(value.to_bytes(2, "big") for value in values)


Sizes = Sequence[int] | None
"""Possible lengths of a frame that begins here, the likeliest first. Empty: no frame begins here. None: more bytes are needed."""


def reply_sizes(buffer: bytes, at: int) -> Sizes:
    """Return the lengths of what a master may receive: a reply, an exception, or its own request."""
    left = len(buffer) - at
    if buffer[at] > MAX_UNIT:
        return ()
    if left < 2:
        return None
    function = buffer[at + 1]
    if function == Function.READ_HOLDING:
        if left < 3:
            return None
        count = buffer[at + 2]
        is_reply = count and count % 2 == 0 and count <= 2 * MAX_READ
        return (REPLY_OVERHEAD + count, READ_SIZE) if is_reply else (READ_SIZE,)
    if function == Function.WRITE_MULTIPLE:
        return (WRITE_SIZE, *_multiple_size(buffer, at)) if left >= WRITE_SIZE else (WRITE_SIZE,)
    if function == Function.WRITE_SINGLE:
        return (WRITE_SIZE,)
    return (EXCEPTION_SIZE,) if function & REFUSED and function & ~REFUSED in NAMES else ()


FIXED = {1: 8, 2: 8, 3: 8, 4: 8, 5: 8, 6: 8, 7: 4, 8: 8, 11: 4, 12: 4, 17: 4, 22: 10, 24: 6}
"""Function -> bytes of its request. Includes the standard's other functions, which a device refuses by exception 1."""
COUNTED = {15: 6, 16: 6, 23: 10}
"""Function -> index of the byte that counts the rest."""


def request_sizes(buffer: bytes, at: int) -> Sizes:
    """Return the lengths of what a device may receive."""
    left = len(buffer) - at
    if buffer[at] > MAX_UNIT:
        return ()
    if left < 2:
        return None
    function = buffer[at + 1]
    if function in FIXED:
        return (FIXED[function],)
    if function not in COUNTED:
        return ()
    index = COUNTED[function]
    if left <= index:
        return None
    if function == Function.WRITE_MULTIPLE:
        return _multiple_size(buffer, at)
    return (index + 1 + buffer[at + index] + CRC_SIZE,)


def _multiple_size(buffer: bytes, at: int) -> Sequence[int]:
    """Return the length of a write of several registers, if its count and byte count agree."""
    count = buffer[at + 4] << 8 | buffer[at + 5]
    size = buffer[at + 6]
    return (MULTIPLE_OVERHEAD + size,) if size == 2 * count and 1 <= count <= MAX_WRITE else ()


SIZES: dict[str, Callable[[bytes, int], Sizes]] = {"master": reply_sizes, "device": request_sizes}


class ModbusCodec(StreamCodec[Frame]):
    """Finds frames in a stream. Its memory is bounded: it keeps fewer bytes than the frame that they may begin."""

    __slots__ = ("_sizes",)

    def __init__(self, end: Literal["master", "device"] = "master") -> None:
        """`end`: which end of the line; a master receives replies, a device requests."""
        super().__init__()
        self._sizes = SIZES[end]

    def next_reply(self) -> Frame | None:
        """Return the next frame with a right CRC; skips and counts bytes that cannot begin one."""
        buffer = self.buffer
        for at in range(len(buffer)):
            sizes = self._sizes(buffer, at)
            if sizes is None:
                self.skip(at)
                return None
            for size in sizes:
                end = at + size
                if end > len(buffer):
                    # It may become complete. A shorter interpretation must not be accepted before.
                    self.skip(at)
                    return None
                if _crc_fits(buffer, at, end):
                    frame = self.cut(at, end)
                    return Frame(frame[0], frame[1], frame[2:-CRC_SIZE], frame)
        self.skip(len(buffer))
        return None

    def describe(self, frame: bytes, *, sent: bool) -> str:
        return describe(frame, sent=sent)


def _crc_fits(buffer: bytes, at: int, end: int) -> bool:
    return crc16(buffer[at : end - CRC_SIZE]) == buffer[end - 2] | buffer[end - 1] << 8


def rename(frame: bytes, rng: Random) -> bytes:
    """Return the same frame with another unit's id."""
    unit = 1 + (frame[0] - 1 + rng.randint(1, MAX_UNIT - 1)) % MAX_UNIT
    return encode(unit, frame[1], frame[2:-CRC_SIZE])


def node_of(frame: bytes) -> int:
    """Return the unit of a complete frame."""
    return frame[0]


def describe(frame: bytes, *, sent: bool) -> str:
    """Return one line about a frame, for `decode` and `--trace`."""
    reply = decode_single(ModbusCodec("device" if sent else "master"), frame)
    if reply is None:
        return f"not a Modbus-RTU frame: {frame.hex(' ')}"
    who = "all" if reply.unit == BROADCAST else f"unit {reply.unit}"
    function = reply.function & ~REFUSED
    name = NAMES.get(function, f"function 0x{function:02X}")  # type: ignore[call-overload]
    return f"{who} {name} {_describe_data(reply, sent)}".rstrip()


def _describe_data(frame: Frame, sent: bool) -> str:
    data = frame.data
    if frame.function & REFUSED:
        return f"refused: exception {data[0]}"
    if not sent and frame.function == Function.READ_HOLDING and len(data) % 2:
        return " ".join(map(str, unpack(data[1:])))
    if frame.function == Function.WRITE_SINGLE:
        return "{} = {}".format(*unpack(data))
    if frame.function in NAMES:
        address, count = unpack(data[:4])
        last = address + count - 1
        values = f" = {' '.join(map(str, unpack(data[5:])))}" if len(data) > 4 else ""
        return f"{address} to {last}{values}" if count > 1 else f"{address}{values}"
    return data.hex(" ")
