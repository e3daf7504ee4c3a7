"""Reads and writes of holding registers as requests that know their reply (ROH Modbus, 3.1 to 3.4).

A write's reply repeats the address and the value or count, so it cannot be confused with another one. A read's reply names only
the unit and the number of bytes: that is its `reply_key`, and a fence is a read of another number of registers. The reply to a
single write (0x06) equals the request, and an echo looks the same; so one register is written with 0x10 too, unless the config
says otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar, cast

from servobus.errors import DeviceError
from servobus.protocols.base import Request
from servobus.protocols.modbus import codec
from servobus.protocols.modbus.codec import BROADCAST, MAX_READ, MAX_WRITE, REFUSED, WRITE_SIZE, Frame, Function, pack

R = TypeVar("R")

MIN_GAP = 0.00175
"""Seconds between two frames above 19200 baud."""
GAP_CHARACTERS = 3.5
CHARACTER_BITS = 11
TURNAROUND = 0.1
"""Seconds of silence after a broadcast; "Modbus over serial line" recommends 100 to 200 ms."""
UNANSWERED_PATIENCE = 0.005
"""Seconds within which a reply that is not waited for is expected to begin; no document gives a time."""

EXCEPTIONS = {
    0x01: "illegal function",
    0x02: "illegal data address",
    0x03: "illegal data value",
    0x04: "device failure",
    0x05: "accepted, and still in progress",
    0x06: "busy",
    0x08: "memory parity error",
    0x0A: "gateway path unavailable",
    0x0B: "gateway: the unit did not answer",
}
DEVICE_FAILURE = 0x04
NO_ANSWER = 0x0B
GATEWAY = frozenset({0x0A, NO_ANSWER})
"""Exceptions that a gateway sends in the unit's name."""


@dataclass(frozen=True, slots=True)
class RtuTiming:
    """The silences that the requests of a line need, in seconds."""

    gap: float = MIN_GAP
    """Between two frames."""
    turnaround: float = TURNAROUND
    """After a broadcast, in addition to the gap."""
    guard: float = MIN_GAP + UNANSWERED_PATIENCE
    """After a write whose reply is not waited for: long enough for a reply that comes nevertheless."""

    @classmethod
    def at(cls, baudrate: int, turnaround: float = TURNAROUND) -> RtuTiming:
        """Return the timing at a baud rate: a gap of 3.5 characters, but at least 1.75 ms."""
        gap = max(MIN_GAP, GAP_CHARACTERS * CHARACTER_BITS / baudrate)
        return cls(gap, turnaround, gap + UNANSWERED_PATIENCE + WRITE_SIZE * CHARACTER_BITS / baudrate)


class ModbusRequest(Request[R]):
    """A request to one unit, or a write to all units."""

    def __init__(self, timing: RtuTiming, unit: int, function: Function, data: bytes, repeated: bytes, size: int) -> None:
        """`repeated`: what the reply repeats, from its third byte on. `size`: bytes of the reply."""
        self.node = unit
        self.frame = codec.encode(unit, function, data)
        self.function = function
        self.repeated = repeated
        self.replies = int(unit != BROADCAST)
        self.nodes = (unit,) if self.replies else ()
        self.reply_size = size
        self.reply_key = codec.reply_key(function, repeated)
        self.quiet_after = timing.gap if self.replies else timing.gap + timing.turnaround

    relayed = True

    def is_silence(self, replies: Sequence[Frame]) -> bool:
        return bool(replies) and replies[0].function & REFUSED != 0 and replies[0].data[0] in GATEWAY

    def answers(self, reply: Frame) -> bool:
        return reply.unit == self.node and (self._matches(reply) or reply.function == self.function | REFUSED)

    def _matches(self, reply: Frame) -> bool:
        return reply.function == self.function and reply.data == self.repeated

    def parse(self, replies: Sequence[Frame]) -> R:
        if replies and replies[0].function & REFUSED:
            raise self.refusal(replies[0])
        return self.value(replies[0].data if replies else b"")

    def refusal(self, reply: Frame) -> DeviceError:
        """Return the error for an exception reply."""
        code = reply.data[0]
        meaning = EXCEPTIONS.get(code, "an exception of its own")
        return DeviceError(f"unit {self.node} refused: {meaning} ({code})", code=code, request=self, raw=reply.frame)

    def value(self, data: bytes) -> R:
        """Return the value of a reply that is not an exception. The default is for writes, whose reply only repeats them."""
        return cast("R", None)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.frame.hex(' ')})"


class ReadHolding(ModbusRequest[R]):
    """0x03: reads `count` registers from `address` on."""

    changes = False

    def __init__(self, timing: RtuTiming, unit: int, address: int, count: int, make: Callable[[Sequence[int]], R]) -> None:
        """`make`: returns the request's value for the registers. Raises ValueError outside 1 to 125 registers."""
        if unit == BROADCAST or not 1 <= count <= MAX_READ:
            raise ValueError(f"a read asks one unit for 1 to {MAX_READ} registers, found unit {unit}, {count} registers")
        size = 2 * count
        super().__init__(timing, unit, Function.READ_HOLDING, pack((address, count)), bytes((size,)), codec.REPLY_OVERHEAD + size)
        self.address = address
        self.count = count
        self.make = make

    def _matches(self, reply: Frame) -> bool:
        return reply.function == self.function and reply.data[:1] == self.repeated and len(reply.data) == 2 * self.count + 1

    def value(self, data: bytes) -> R:
        return self.make(codec.unpack(data[1:]))


class UnitRead(ReadHolding[R]):
    """A read that only the unit itself answers: a gateway's refusal says nothing about the unit, so it counts as silence."""

    def answers(self, reply: Frame) -> bool:
        return super().answers(reply) and not (reply.function & REFUSED and reply.data[0] in GATEWAY)


class PresenceRead(UnitRead[R | None]):
    """A read that shows whether the unit is there. A refusal by the unit shows it too (None)."""

    def answers(self, reply: Frame) -> bool:
        return super().answers(reply) and not (reply.function & REFUSED and reply.data[0] in GATEWAY)

    def parse(self, replies: Sequence[Frame]) -> R | None:
        return None if replies[0].function & REFUSED else super().parse(replies)


class Fence(PresenceRead[R]):
    """A read of a number of registers that no reply still under way can have.

    It is not repeated: the next fence needs another number, or this one's late reply could answer it.
    """

    idempotent = False

    def __init__(
        self, timing: RtuTiming, unit: int, address: int, count: int, make: Callable[[Sequence[int]], R], *, refusable: bool
    ) -> None:
        """`refusable`: no other read is under way, so a refusal can only answer this one."""
        super().__init__(timing, unit, address, count, make)
        self.refusable = refusable

    def answers(self, reply: Frame) -> bool:
        return super().answers(reply) and (self.refusable or not reply.function & REFUSED)


class WriteSingle(ModbusRequest[None]):
    """0x06: writes one register. Only for lines without an echo, because the correct reply equals the request."""

    mirrored = True
    changes = True

    def __init__(self, timing: RtuTiming, unit: int, address: int, value: int, *, repeat: bool = True) -> None:
        """`repeat`: it may be sent again when no reply came."""
        data = pack((address, value))
        super().__init__(timing, unit, Function.WRITE_SINGLE, data, data, WRITE_SIZE)
        self.idempotent = repeat


class WriteMultiple(ModbusRequest[None]):
    """0x10: writes registers from `address` on. A unit may stop at the first one it refuses, so a refused write may be applied in
    part."""

    changes = True

    def __init__(self, timing: RtuTiming, unit: int, address: int, values: Sequence[int], *, repeat: bool = True) -> None:
        """`repeat`: it may be sent again when no reply came. Raises ValueError outside 1 to 123 values."""
        count = len(values)
        if not 1 <= count <= MAX_WRITE:
            raise ValueError(f"a write carries 1 to {MAX_WRITE} registers, found {count}")
        span = pack((address, count))
        super().__init__(timing, unit, Function.WRITE_MULTIPLE, span + bytes((2 * count,)) + pack(values), span, WRITE_SIZE)
        self.idempotent = repeat
        self.address = address
        self.count = count


class UnansweredWrite(WriteMultiple):
    """A write whose reply is not waited for; the line stays silent as long as a reply would take."""

    replies = 0

    def __init__(self, timing: RtuTiming, unit: int, address: int, values: Sequence[int]) -> None:
        super().__init__(timing, unit, address, values)
        self.replies = 0
        self.nodes = ()
        self.quiet_after = timing.guard
