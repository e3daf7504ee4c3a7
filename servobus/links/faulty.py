"""A line that goes wrong as real ones do: it stands before another far end and damages what that says to the master.

Every fault has a share of the replies it strikes (`FaultOptions`), from a seeded source, so a run can be had again. A node and
its UART are a queue: behind a reply that is late, the later ones of the same node wait.
"""

from __future__ import annotations

import asyncio
import random
from collections import Counter, deque
from collections.abc import Callable, Hashable, Iterator

from servobus.links.base import FarEnd
from servobus.protocols.options import FaultOptions

Rename = Callable[[bytes, random.Random], bytes]
Damage = Callable[[bytes, random.Random], bytes]

MAX_NOISE = 3
"""Zero bytes before a reply: what a line without bias resistors shows."""
LONGEST_PIECE = 5


def _drop_byte(frame: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(frame))
    return frame[:at] + frame[at + 1 :]


def _insert_byte(frame: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(frame) + 1)
    return frame[:at] + bytes((rng.randrange(256),)) + frame[at:]


def _flip(frame: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(frame))
    return frame[:at] + bytes((frame[at] ^ rng.randrange(1, 256),)) + frame[at + 1 :]


DAMAGES: dict[str, Damage] = {
    "loss": lambda frame, rng: b"",
    "truncate": lambda frame, rng: frame[: rng.randrange(len(frame))],
    "drop_byte": _drop_byte,
    "insert_byte": _insert_byte,
    "flip": _flip,
    "duplicate": lambda frame, rng: frame + frame,
    "noise": lambda frame, rng: bytes(rng.randint(1, MAX_NOISE)) + frame,
}
"""Fault -> what is left of the frame, in the order in which they strike."""


class FaultyEnd:
    """See `links.base.FarEnd`. `rename` puts a frame in the name of another node, `node_of` tells whose it is."""

    def __init__(
        self,
        far: FarEnd,
        options: FaultOptions,
        loop: asyncio.AbstractEventLoop,
        *,
        rename: Rename,
        node_of: Callable[[bytes], Hashable],
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._far = far
        self._options = options
        self._loop = loop
        self._rng = random.Random(options.seed)
        self._node_of = node_of
        self._damages = {"wrong_id": rename, **DAMAGES}
        self._deliver: Callable[[bytes], None] = _nobody
        self._late: dict[Hashable, deque[bytes]] = {}
        self._late_until: dict[Hashable, float] = {}
        self._pieces: deque[bytes] = deque()
        far.attach(self._heard)

    def attach(self, deliver: Callable[[bytes], None]) -> None:
        self._deliver = deliver

    def set_baudrate(self, baudrate: int) -> None:
        self._far.set_baudrate(baudrate)

    def receive(self, data: bytes) -> None:
        if self._strikes("echo"):
            self._say(data)
        self._far.receive(data)

    def _heard(self, frame: bytes) -> None:
        """The far end said a frame."""
        node = self._node_of(frame)
        delay = self._rng.uniform(0, self._options.delay_ms / 1000) if self._strikes("late") else 0.0
        for name, damage in self._damages.items():
            if frame and self._strikes(name):
                frame = damage(frame, self._rng)
        if delay or self._late.get(node):
            self._say_late(node, frame, delay)
        else:
            self._say(frame)

    def _say_late(self, node: Hashable, frame: bytes, delay: float) -> None:
        """Behind what this node still has to say. It is the queue that keeps the order: a loop does not, between timers that
        are due at the same moment."""
        due = max(self._loop.time() + delay, self._late_until.get(node, 0.0))
        self._late_until[node] = due
        queue = self._late.setdefault(node, deque())
        queue.append(frame)
        self._loop.call_at(due, lambda: self._say(queue.popleft()))

    def _strikes(self, fault: str) -> bool:
        share: float = getattr(self._options, fault)
        struck = share > 0 and self._rng.random() < share
        self.counts[fault] += struck
        return struck

    def _say(self, data: bytes) -> None:
        """In pieces, one in each pass of the loop, behind what is still to be said."""
        if not data:
            return
        if not self._pieces:
            self._loop.call_soon(self._next_piece)
        self._pieces.extend(self._chopped(data))

    def _next_piece(self) -> None:
        piece = self._pieces.popleft()
        if self._pieces:
            self._loop.call_soon(self._next_piece)
        self._deliver(piece)

    def _chopped(self, data: bytes) -> Iterator[bytes]:
        if self._options.chop == "whole":
            yield data
            return
        while data:
            size = 1 if self._options.chop == "bytes" else self._rng.randint(1, LONGEST_PIECE)
            yield data[:size]
            data = data[size:]


def _nobody(data: bytes) -> None:
    """Where nothing is attached, nothing is heard."""
