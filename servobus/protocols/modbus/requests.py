"""Reading and writing holding registers (ROH seed 3.1 to 3.4) as requests that know their reply.

A write brings back its address, and value or number, so its answer is known for sure. The answer to a read says unit and byte
count only: that is its `reply_key`, and a fence is a read of another number of registers. The answer to a single write (0x06) is
the question itself, and an echo of it looks the same; so single registers are written with 0x10 unless the config says otherwise.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from servobus.errors import DeviceError
from servobus.protocols.base import Request
from servobus.protocols.modbus.codec import (
    BROADCAST,
    MAX_READ,
    MAX_WRITE,
    READ_SIZE,
    REFUSED,
    REPLY_OVERHEAD,
    WRITE_SIZE,
    Frame,
    Function,
    encode,
    pack,
    reply_key,
    words,
)

R = TypeVar("R")

MIN_GAP = 0.00175
"""Seconds between two frames above 19200 baud."""
GAP_CHARACTERS = 3.5
CHARACTER_BITS = 11
TURNAROUND = 0.1
"""Seconds a unit gets after a broadcast; Modbus serial line names 100 to 200 ms."""
PATIENCE = 0.005
"""Seconds within which an answer that nobody waits for is expected to begin; no document names a time."""

EXCEPTIONS = {
    0x01: "illegal function",
    0x02: "illegal data address",
    0x03: "illegal data value",
    0x04: "device failure",
    0x05: "accepted, and still at work",
    0x06: "busy",
    0x08: "memory parity error",
    0x0A: "gateway path unavailable",
    0x0B: "gateway: the unit did not answer",
}
DEVICE_FAILURE = 0x04
NO_ANSWER = 0x0B
GATEWAY = frozenset({0x0A, NO_ANSWER})
"""Said by who passes the question on, not by the unit."""


@dataclass(frozen=True, slots=True)
class FrameTiming:
    """What every request of a line has in common. Seconds."""

    gap: float = MIN_GAP
    """Silence between two frames."""
    turnaround: float = TURNAROUND
    """More silence after a broadcast."""
    guard: float = MIN_GAP + PATIENCE
    """Silence after what is told to a unit that does not answer: time for an answer that comes nevertheless."""

    @classmethod
    def at(cls, baudrate: int, turnaround: float = TURNAROUND) -> FrameTiming:
        """3.5 characters, and not below 1.75 ms."""
        gap = max(MIN_GAP, GAP_CHARACTERS * CHARACTER_BITS / baudrate)
        return cls(gap, turnaround, gap + PATIENCE + WRITE_SIZE * CHARACTER_BITS / baudrate)


class ModbusRequest(Request[R]):
    """One question to one unit, or a write to all of them."""

    def __init__(self, timing: FrameTiming, unit: int, function: Function, body: bytes, told: bytes, size: int) -> None:
        """`told`: what the answer repeats, from its third byte on; `size`: bytes of the answer."""
        self.node = unit
        self.frame = encode(unit, function, body)
        self.function = function
        self.told = told
        self.replies = int(unit != BROADCAST)
        self.nodes = (unit,) if self.replies else ()
        self.reply_size = size
        self.reply_key = reply_key(function, told)
        self.quiet_after = timing.gap if self.replies else timing.gap + timing.turnaround

    def answers(self, reply: Frame) -> bool:
        return reply.unit == self.node and (self._fits(reply) or reply.function == self.function | REFUSED)

    def _fits(self, reply: Frame) -> bool:
        return reply.function == self.function and reply.body == self.told

    def parse(self, replies: Sequence[Frame]) -> R:
        if replies and replies[0].function & REFUSED:
            raise self.refusal(replies[0])
        return self.value(replies[0].body if replies else b"")

    def refusal(self, reply: Frame) -> DeviceError:
        code = reply.body[0]
        meaning = EXCEPTIONS.get(code, "an exception of its own")
        return DeviceError(f"unit {self.node} refused: {meaning} ({code})", code=code, request=self, raw=reply.frame)

    @abstractmethod
    def value(self, body: bytes) -> R:
        """Of an answer that is no exception."""

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.frame.hex(' ')})"


class ReadHolding(ModbusRequest[R]):
    """0x03: `count` registers from `address` on; `make` makes the value of them. Raises ValueError above 125."""

    def __init__(self, timing: FrameTiming, unit: int, address: int, count: int, make: Callable[[Sequence[int]], R]) -> None:
        if unit == BROADCAST or not 1 <= count <= MAX_READ:
            raise ValueError(f"a read asks one unit for 1 to {MAX_READ} registers, found unit {unit}, {count} registers")
        size = 2 * count
        super().__init__(timing, unit, Function.READ_HOLDING, pack((address, count)), bytes((size,)), REPLY_OVERHEAD + size)
        self.address = address
        self.count = count
        self.make = make

    def _fits(self, reply: Frame) -> bool:
        return reply.function == self.function and reply.body[:1] == self.told and len(reply.body) == 2 * self.count + 1

    def value(self, body: bytes) -> R:
        return self.make(words(body[1:]))


class Probe(ReadHolding[R | None]):
    """A read that asks whether the unit is there: it is, too, when it refuses (None); but not when a gateway speaks for it."""

    def answers(self, reply: Frame) -> bool:
        return super().answers(reply) and not (reply.function & REFUSED and reply.body[0] in GATEWAY)

    def parse(self, replies: Sequence[Frame]) -> R | None:
        return None if replies[0].function & REFUSED else super().parse(replies)


class Fence(Probe[R]):
    """A read whose number of registers nobody asked for lately. Not repeated: the next fence has another number, or its answer
    could be that of this one."""

    idempotent = False

    def __init__(
        self, timing: FrameTiming, unit: int, address: int, count: int, make: Callable[[Sequence[int]], R], *, refusable: bool
    ) -> None:
        """`refusable`: no other read is under way, so that a refusal can only be of this one."""
        super().__init__(timing, unit, address, count, make)
        self.refusable = refusable

    def answers(self, reply: Frame) -> bool:
        return super().answers(reply) and (self.refusable or not reply.function & REFUSED)


class Write(ModbusRequest[None]):
    """What all writes share: what they bring back has been checked by `answers`."""

    def value(self, body: bytes) -> None:
        """The unit took it."""


class WriteSingle(Write):
    """0x06: one register. Its right answer is the question itself, so it is only for lines without an echo."""

    mirrored = True

    def __init__(self, timing: FrameTiming, unit: int, address: int, value: int, *, repeat: bool = True) -> None:
        body = pack((address, value))
        super().__init__(timing, unit, Function.WRITE_SINGLE, body, body, WRITE_SIZE)
        self.idempotent = repeat


class WriteMultiple(Write):
    """0x10: registers from `address` on. A unit may stop at the first it refuses, so a refused write may be applied in part."""

    def __init__(self, timing: FrameTiming, unit: int, address: int, values: Sequence[int], *, repeat: bool = True) -> None:
        """`repeat`: may be said again when no answer came. Raises ValueError outside 1 to 123 values."""
        count = len(values)
        if not 1 <= count <= MAX_WRITE:
            raise ValueError(f"a write carries 1 to {MAX_WRITE} registers, found {count}")
        told = pack((address, count))
        super().__init__(timing, unit, Function.WRITE_MULTIPLE, told + bytes((2 * count,)) + pack(values), told, READ_SIZE)
        self.idempotent = repeat
        self.address = address
        self.count = count


class Tell(WriteMultiple):
    """A write whose answer nobody waits for; the line stays silent for the time that one would take."""

    replies = 0

    def __init__(self, timing: FrameTiming, unit: int, address: int, values: Sequence[int]) -> None:
        super().__init__(timing, unit, address, values)
        self.replies = 0
        self.nodes = ()
        self.quiet_after = timing.guard
