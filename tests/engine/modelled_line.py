"""A line with toy nodes as a simple model knows it: which frame is on it, which values its nodes produced, who is doubtful.

The model shares nothing with the engine. It answers late, damaged, twice or never as a test asks for, but a node's replies
never overtake each other: that is how a UART behaves, and what a fence relies on.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from servobus.engine.turn import Transmit, Turn
from tests.engine.toy_protocol import ALL, PING, READ, REFUSED, WRITE, reply

STOP_WORD, POISON = 0x77, 0xED
NUMBERS = [number for number in range(POISON) if number != 0xA5]
"""Values that nodes produce: never the first byte of a frame."""


@dataclass(slots=True)
class Asked:
    """The frame on the line whose replies are due."""

    kind: int
    deadline: float
    waiting: set[int]


@dataclass(slots=True)
class ModelledLine:
    nodes: tuple[int, ...]
    now: float = 1.0
    asked: Asked | None = None
    frames: int = 0
    turns: int = 0
    missed: int = 0
    values: dict[tuple[int, int], int] = field(default_factory=dict)
    """(node, register) -> the value that the node produced for the newest request of it."""
    newest: dict[tuple[int, int], deque[int]] = field(default_factory=dict)
    """The same with the value before: the next poll may be on the line when the value of a poll is handed over."""
    once: set[int] = field(default_factory=set)
    """Values of writes that were sent: none of them may be sent again."""
    doubtful: set[int] = field(default_factory=set)
    stop_due: bool = False
    """The next frame must be that of the e-stop."""
    broadcasts: list[int] = field(default_factory=list)
    """What was sent to all, newest last."""
    _pending: dict[int, deque[tuple[Asked, bytes]]] = field(default_factory=dict)
    _count: int = 0

    def transmitted(self, action: Transmit) -> None:
        """Check a frame that the engine sends now, and let the nodes produce their replies."""
        node, kind, number = action.frame[1], action.frame[3], action.frame[4]
        self.frames += 1
        assert self.asked is None, "a frame left while the replies to the one before were due"
        if self.stop_due:
            assert (node, kind, number) == (ALL, WRITE, STOP_WORD), "a frame left before the e-stop"
            self.stop_due = False
        if not isinstance(action, Turn):
            assert node == ALL
            self.broadcasts.append(number)
            return
        assert action.deadline > self.now
        nodes = action.request.nodes if node == ALL else (node,)
        if kind != PING:
            assert not self.doubtful & set(nodes), "a doubtful node was asked something else than a fence"
        if kind == WRITE:
            assert number not in self.once, "a request that must not be repeated was repeated"
            self.once.add(number)
        self.asked = Asked(kind, action.deadline, set(nodes))
        for each in nodes:
            self._pending.setdefault(each, deque()).append((self.asked, self._reply(each, kind, number)))

    def _reply(self, node: int, kind: int, number: int) -> bytes:
        value = number
        if kind == READ:
            self._count += 1
            value = self.values[node, number] = NUMBERS[self._count % len(NUMBERS)]
            self.newest.setdefault((node, number), deque(maxlen=2)).append(value)
        assert value != REFUSED
        return reply(node, kind, value).frame

    # What a test lets happen to the replies

    def under_way(self) -> list[int]:
        """The nodes that have replies to deliver."""
        return [node for node, replies in self._pending.items() if replies]

    def deliver(self, node: int) -> bytes:
        """The oldest reply of a node arrives."""
        asked, frame = self._pending[node].popleft()
        if asked is self.asked:
            asked.waiting.discard(node)
            if asked.kind == PING:
                self.doubtful.discard(node)
            if not asked.waiting:
                self.asked = None
                self.turns += 1
        return frame

    def lose(self, node: int) -> bytes:
        """The oldest reply of a node does not arrive as it was sent."""
        return self._pending[node].popleft()[1]

    def silent(self) -> None:
        """The line was lost: nothing of what was under way arrives any more."""
        self._pending.clear()
        self.asked = None
        self.doubtful = set(self.nodes)

    def deadline_passed(self) -> None:
        asked = self.asked
        if asked is not None and self.now >= asked.deadline:
            self.doubtful |= asked.waiting
            self.asked = None
            self.missed += 1
