"""A second witness: lines, servos and joints written from the documents alone, which share no code with the product.

A witness line is a far end of memory links. It splits the master's bytes into frames by its own reading of them, keeps each with
its time, passes it to its servos and sends their replies after the time that the bytes take on the wire. A joint knows how far it
was driven; what gravity does to a limp joint is kept apart.
"""

from __future__ import annotations

import asyncio
import random
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from heapq import heappop, heappush
from urllib.parse import SplitResult

from servobus.links import SCHEMES
from servobus.links.memory import MemoryLink
from servobus.protocols.base import LineTraits
from servobus.timers import FineTimer, clock_of

NEVER = -1.0
REPLY_DELAY = 0.0002
CHECKED_RATE = 9600
"""The rate of a link that is made to check its address alone."""


@dataclass(slots=True)
class Joint:
    """Where a joint is, in steps, and how far it has travelled."""

    position: float = 0.0
    gravity: float = 0.0
    """Steps/s of a limp joint."""
    driven: float = 0.0
    """Steps travelled under drive, both ways."""
    sagged: float = 0.0
    now: float = 0.0

    def go(self, now: float, target: float, speed: float) -> None:
        """Drive towards a position until now."""
        way = target - self.position
        step = min(abs(way), speed * (now - self.now))
        self.position += step if way > 0 else -step
        self.driven += step
        self.now = now

    def turn(self, now: float, velocity: float) -> None:
        """Turn at a velocity until now."""
        way = velocity * (now - self.now)
        self.position += way
        self.driven += abs(way)
        self.now = now

    def hang(self, now: float) -> None:
        """Be limp until now."""
        way = self.gravity * (now - self.now)
        self.position += way
        self.sagged += abs(way)
        self.now = now


class WitnessServo(ABC):
    """What a line and the scenarios need of every servo."""

    node: int

    def __init__(self, node: int) -> None:
        self.node = node
        self.deaf_until = NEVER
        """Until then it hears nothing."""
        self.mute_until = NEVER
        """Until then it does as it is told, and nobody hears its replies."""
        self.off_until = NEVER
        """Until then it has no power."""
        self.loss = 0.0
        """Share of requests and of replies that are lost, each."""
        self.energised_at: list[float] = []
        """When a frame switched its torque on, or moved it where it has no torque switch."""

    def receives(self, now: float, rng: random.Random) -> bool:
        return now >= self.deaf_until and now >= self.off_until and not (self.loss and rng.random() < self.loss)

    def replies(self, now: float, rng: random.Random) -> bool:
        return now >= self.mute_until and not (self.loss and rng.random() < self.loss)

    @abstractmethod
    def advance(self, now: float) -> None:
        """Let its joints move until now."""

    @abstractmethod
    def driven(self) -> float:
        """Steps that its joints have travelled under drive."""

    @abstractmethod
    def cut_power(self, now: float, seconds: float) -> None:
        """Take its power away for so long: what is not kept is lost."""


@dataclass(slots=True)
class Sent:
    """A frame of the master."""

    time: float
    """When its last byte had left."""
    data: bytes


class WitnessLine(ABC):
    """A far end (see `links.base.FarEnd`) with servos of one protocol."""

    def __init__(self, servos: Sequence[WitnessServo], *, baudrate: int, rng: random.Random) -> None:
        self.servos = {servo.node: servo for servo in servos}
        self.log: list[Sent] = []
        self.rng = rng
        self.alter: Callable[[int, bytes], bytes] = lambda node, reply: reply
        """What becomes of a reply on the way."""
        loop = asyncio.get_running_loop()
        self.clock = clock_of(loop)
        self.dead = False
        """Nothing reaches anybody on this line, and it takes its bytes all the same."""
        self._timer = FineTimer(loop, self._on_time)
        self._due: list[tuple[float, int, Callable[[], object]]] = []
        self._count = 0
        self._byte_time = 10.0 / baudrate
        self._free = 0.0
        self._buffer = b""
        self._deliver: Callable[[bytes], object] = bytes

    def attach(self, deliver: Callable[[bytes], None]) -> None:
        self._deliver = deliver

    def set_baudrate(self, baudrate: int) -> None:
        self._byte_time = 10.0 / baudrate

    def receive(self, data: bytes) -> None:
        self._free = max(self.clock(), self._free) + len(data) * self._byte_time
        self._buffer += data
        while frame := self._next_frame():
            self.log.append(Sent(self._free, frame))
            if not self.dead:
                self._later(self._free, partial(self._handle, frame, self._free))

    def settle(self) -> None:
        """Let every joint move until now."""
        for servo in self.servos.values():
            servo.advance(self.clock())

    def close(self) -> None:
        self._timer.close()

    def _later(self, when: float, call: Callable[[], object]) -> None:
        self._count += 1
        heappush(self._due, (when, self._count, call))
        self._timer.arm(self._due[0][0])

    def _on_time(self) -> None:
        while self._due and self._due[0][0] <= self.clock():
            heappop(self._due)[2]()
        if self._due:
            self._timer.arm(self._due[0][0])

    def _next_frame(self) -> bytes:
        while self._buffer:
            size = self.size_of(self._buffer)
            if size == 0:
                return b""
            if size > 0:
                frame, self._buffer = self._buffer[:size], self._buffer[size:]
                return frame
            self._buffer = self._buffer[1:]
        return b""

    def _handle(self, frame: bytes, now: float) -> None:
        due = now
        for node, reply in self.answers(frame, now):
            altered = self.alter(node, reply)
            if altered:
                due += REPLY_DELAY + len(altered) * self._byte_time
                self._later(due, partial(self._deliver, altered))

    @abstractmethod
    def size_of(self, data: bytes) -> int:
        """Return the size of the whole frame at the beginning; 0: more bytes are needed; -1: none begins here."""

    @abstractmethod
    def answers(self, frame: bytes, now: float) -> Iterator[tuple[int, bytes]]:
        """Let the servos do what the frame asks for; yield their replies."""


class Lines:
    """One link to each witness line, by the host name of its address: a config that is only checked makes no other."""

    def __init__(self, lines: dict[str, WitnessLine]) -> None:
        self._lines = lines
        self._links: dict[str, MemoryLink] = {}

    def build(self, parts: SplitResult, baudrate: int) -> MemoryLink:
        name = parts.hostname
        assert name is not None
        if name not in self._links:
            self._links[name] = MemoryLink(self._lines[name], LineTraits(paced=True), parts.geturl())
        if baudrate != CHECKED_RATE:
            self._links[name].traits = LineTraits(baudrate, paced=True)
        return self._links[name]


@contextmanager
def witnessed(**lines: WitnessLine) -> Iterator[None]:
    """While this lasts, the port `witness://NAME` of a config is the line of that name."""
    SCHEMES["witness"] = (Lines(lines).build, "witness://NAME")
    try:
        yield
    finally:
        del SCHEMES["witness"]
