"""A fault injector: it passes bytes between a master and a far end, and damages the replies as a bad line does.

`FaultOptions` gives the share of replies that each fault hits. The random source is seeded, so a run can be repeated. The replies
of one node keep their order: a reply waits while an earlier one of the same node is delayed.
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
"""Zero bytes in front of a reply, as on a line without bias resistors."""
MAX_PIECE = 5
"""Bytes that arrive together with `chop: random`."""


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
"""Fault -> function that returns the damaged frame, in the order in which they are applied."""


class FaultyEnd:
    """A far end with faults; see `links.base.FarEnd`."""

    def __init__(
        self,
        far: FarEnd,
        options: FaultOptions,
        loop: asyncio.AbstractEventLoop,
        *,
        rename: Rename,
        node_of: Callable[[bytes], Hashable],
    ) -> None:
        """Put faults in front of `far`.

        Args:
            rename: returns a reply frame with another node's id and a valid checksum.
            node_of: returns the node of a reply frame.
        """
        self.counts: Counter[str] = Counter()
        """Fault -> replies it has hit."""
        self._far = far
        self._options = options
        self._loop = loop
        self._rng = random.Random(options.seed)
        self._node_of = node_of
        self._damages = {"wrong_id": rename, **DAMAGES}
        self._deliver: Callable[[bytes], None] = _discard
        self._late: dict[Hashable, deque[bytes]] = {}
        self._late_until: dict[Hashable, float] = {}
        self._pieces: deque[bytes] = deque()
        far.attach(self._on_reply)

    def attach(self, deliver: Callable[[bytes], None]) -> None:
        self._deliver = deliver

    def set_baudrate(self, baudrate: int) -> None:
        self._far.set_baudrate(baudrate)

    def receive(self, data: bytes) -> None:
        if self._hits("echo"):
            self._send(data)
        self._far.receive(data)

    def _on_reply(self, frame: bytes) -> None:
        """Damage one reply frame of the far end, and pass it on now or later."""
        node = self._node_of(frame)
        delay = self._rng.uniform(0, self._options.delay_ms / 1000) if self._hits("late") else 0.0
        for name, damage in self._damages.items():
            if frame and self._hits(name):
                frame = damage(frame, self._rng)
        if delay or self._late.get(node):
            self._send_late(node, frame, delay)
        else:
            self._send(frame)

    def _send_late(self, node: Hashable, frame: bytes, delay: float) -> None:
        """Send a reply after those that the node still has to send.

        The queue keeps their order; the loop does not keep it between timers that are due at the same time.
        """
        due = max(self._loop.time() + delay, self._late_until.get(node, 0.0))
        self._late_until[node] = due
        queue = self._late.setdefault(node, deque())
        queue.append(frame)
        self._loop.call_at(due, lambda: self._send(queue.popleft()))

    def _hits(self, fault: str) -> bool:
        share: float = getattr(self._options, fault)
        hit = share > 0 and self._rng.random() < share
        self.counts[fault] += hit
        return hit

    def _send(self, data: bytes) -> None:
        """Queue data behind the pieces that wait; each pass of the loop delivers one piece."""
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
            size = 1 if self._options.chop == "bytes" else self._rng.randint(1, MAX_PIECE)
            yield data[:size]
            data = data[size:]


def _discard(data: bytes) -> None:
    """Drop what arrives while no master is attached."""
