"""Modbus-RTU frames (ROH seed 1 and 3): unit, function, data, CRC-16 with its low byte first.

RTU has no header and ends a frame by silence, which a codec cannot hear. So lengths are predicted from function and byte count,
and a frame counts only when its CRC fits. Questions and answers have other lengths, hence one codec with a table for each end of
the line; the master's also knows its own questions, because some lines echo them.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from enum import IntEnum
from random import Random
from typing import Literal, NamedTuple

BROADCAST = 0
MAX_UNIT = 247
MAX_READ = 125
"""Registers of one question: their bytes, and the frame, must be counted in one byte (256 bytes at most)."""
MAX_WRITE = 123
REFUSED = 0x80
"""Set in the function of an exception."""
CRC_SIZE = 2
READ_SIZE = WRITE_SIZE = 8
"""Bytes of a question for registers, of a single write either way, and of the answer to a write of many."""
EXCEPTION_SIZE = 5
MULTIPLE_OVERHEAD = 9
"""Bytes of a write of many registers, without their values."""
REPLY_OVERHEAD = 5
"""Bytes of an answer with registers, without their values."""


class Function(IntEnum):
    """Seed 3.1 to 3.3."""

    READ_HOLDING = 0x03
    WRITE_SINGLE = 0x06
    WRITE_MULTIPLE = 0x10


NAMES = {Function.READ_HOLDING: "READ", Function.WRITE_SINGLE: "WRITE ONE", Function.WRITE_MULTIPLE: "WRITE"}


class Frame(NamedTuple):
    """One frame, either way. `body` is what stands between function and CRC."""

    unit: int
    function: int
    body: bytes
    frame: bytes

    @property
    def node(self) -> int:
        return self.unit

    @property
    def status(self) -> None:
        """Modbus has no health byte."""

    @property
    def key(self) -> Hashable:
        """An answer with registers names neither their address nor the question: only how many bytes they are."""
        return reply_key(self.function, self.body[:1] if self.function == Function.READ_HOLDING else self.body[:4])


def reply_key(function: int, told: bytes) -> tuple[int, bytes]:
    """What tells answers of one unit apart; `told`: what the answer repeats of the question."""
    return (function, told)


def _crc_of(byte: int) -> int:
    for _ in range(8):
        byte = byte >> 1 ^ (0xA001 if byte & 1 else 0)
    return byte


TABLE = tuple(_crc_of(byte) for byte in range(256))


def crc16(data: bytes) -> int:
    """Polynomial 0xA001, from 0xFFFF on."""
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ TABLE[(crc ^ byte) & 0xFF]
    return crc


def encode(unit: int, function: int, body: bytes) -> bytes:
    """The frame's bytes. Raises ValueError for a unit that cannot be addressed."""
    if not 0 <= unit <= MAX_UNIT:
        raise ValueError(f"unit {unit} is outside 1 to {MAX_UNIT} (or {BROADCAST} for all)")
    head = bytes((unit, function)) + body
    return head + crc16(head).to_bytes(CRC_SIZE, "little")


def words(data: bytes) -> list[int]:
    """Registers travel high byte first."""
    return [data[at] << 8 | data[at + 1] for at in range(0, len(data) - 1, 2)]


def pack(values: Sequence[int]) -> bytes:
    return b"".join(value.to_bytes(2, "big") for value in values)


Sizes = Sequence[int] | None
"""Lengths a frame that begins here may have, the likeliest first; none: no frame begins here; None: too few bytes to tell."""


def reply_sizes(buffer: bytes, at: int) -> Sizes:
    """What a master may hear: an answer, an exception, or its own question."""
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
        answer = count and count % 2 == 0 and count <= 2 * MAX_READ
        return (REPLY_OVERHEAD + count, READ_SIZE) if answer else (READ_SIZE,)
    if function == Function.WRITE_MULTIPLE:
        return (WRITE_SIZE, *_multiple_size(buffer, at)) if left >= WRITE_SIZE else (WRITE_SIZE,)
    if function == Function.WRITE_SINGLE:
        return (WRITE_SIZE,)
    return (EXCEPTION_SIZE,) if function & REFUSED and function & ~REFUSED in NAMES else ()


FIXED = {1: 8, 2: 8, 3: 8, 4: 8, 5: 8, 6: 8, 7: 4, 8: 8, 11: 4, 12: 4, 17: 4, 22: 10, 24: 6}
"""Function -> bytes of its question. The standard's others are here too: a device refuses them by name (EC01)."""
COUNTED = {15: 6, 16: 6, 23: 10}
"""Function -> place of the byte that counts the rest."""


def request_sizes(buffer: bytes, at: int) -> Sizes:
    """What a device may hear."""
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
    place = COUNTED[function]
    if left <= place:
        return None
    if function == Function.WRITE_MULTIPLE:
        return _multiple_size(buffer, at)
    return (place + 1 + buffer[at + place] + CRC_SIZE,)


def _multiple_size(buffer: bytes, at: int) -> Sequence[int]:
    """Of a write of many registers, where number and byte count fit each other."""
    count = buffer[at + 4] << 8 | buffer[at + 5]
    size = buffer[at + 6]
    return (MULTIPLE_OVERHEAD + size,) if size == 2 * count and 1 <= count <= MAX_WRITE else ()


SIZES: dict[str, Callable[[bytes, int], Sizes]] = {"master": reply_sizes, "device": request_sizes}


class ModbusCodec:
    """Finds frames in a stream. Memory is bounded: what is kept between two calls is shorter than the frame it may begin."""

    __slots__ = ("_buffer", "_sizes", "skipped")

    def __init__(self, end: Literal["master", "device"] = "master") -> None:
        """`end`: of the line; a master hears answers, a device questions."""
        self._buffer = b""
        self._sizes = SIZES[end]
        self.skipped = 0

    @property
    def pending(self) -> int:
        return len(self._buffer)

    def receive_data(self, data: bytes) -> None:
        self._buffer = self._buffer + data if self._buffer else bytes(data)

    def reset(self) -> None:
        self._buffer = b""

    def next_reply(self) -> Frame | None:
        """The next frame with a right CRC; what cannot begin one is skipped and counted."""
        buffer = self._buffer
        for at in range(len(buffer)):
            sizes = self._sizes(buffer, at)
            if sizes is None:
                self._drop(at)
                return None
            for size in sizes:
                end = at + size
                if end > len(buffer):
                    # It may be whole later; a shorter reading of it must not be believed before that is known.
                    self._drop(at)
                    return None
                if _crc_fits(buffer, at, end):
                    self._drop(at)
                    self._buffer = buffer[end:]
                    return Frame(buffer[at], buffer[at + 1], buffer[at + 2 : end - CRC_SIZE], buffer[at:end])
        self._drop(len(buffer))
        return None

    def describe(self, frame: bytes, *, sent: bool) -> str:
        return describe(frame, sent=sent)

    def _drop(self, count: int) -> None:
        self.skipped += count
        self._buffer = self._buffer[count:]


def _crc_fits(buffer: bytes, at: int, end: int) -> bool:
    return crc16(buffer[at : end - CRC_SIZE]) == buffer[end - 2] | buffer[end - 1] << 8


def rename(frame: bytes, rng: Random) -> bytes:
    """The same frame in the name of another unit."""
    unit = 1 + (frame[0] - 1 + rng.randint(1, MAX_UNIT - 1)) % MAX_UNIT
    return encode(unit, frame[1], frame[2:-CRC_SIZE])


def node_of(frame: bytes) -> int:
    """The unit of a whole frame."""
    return frame[0]


def describe(frame: bytes, *, sent: bool) -> str:
    """A frame in words: what `decode` and `--trace` print."""
    codec = ModbusCodec("device" if sent else "master")
    codec.receive_data(frame)
    found = codec.next_reply()
    if found is None or found.frame != frame:
        return f"no Modbus-RTU frame: {frame.hex(' ')}"
    who = "all" if found.unit == BROADCAST else f"unit {found.unit}"
    function = found.function & ~REFUSED
    name = NAMES.get(function, f"function 0x{function:02X}")  # type: ignore[call-overload]
    return f"{who} {name} {_describe_body(found, sent)}".rstrip()


def _describe_body(frame: Frame, sent: bool) -> str:
    body = frame.body
    if frame.function & REFUSED:
        return f"refused: exception {body[0]}"
    if not sent and frame.function == Function.READ_HOLDING and len(body) % 2:
        return " ".join(map(str, words(body[1:])))
    if frame.function == Function.WRITE_SINGLE:
        return "{} = {}".format(*words(body))
    if frame.function in NAMES:
        address, count = words(body[:4])
        last = address + count - 1
        values = f" = {' '.join(map(str, words(body[5:])))}" if len(body) > 4 else ""
        return f"{address} to {last}{values}" if count > 1 else f"{address}{values}"
    return body.hex(" ")
