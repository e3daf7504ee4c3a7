"""A turn: one request on the line, and what was received since. Pure.

A turn judges the window in which its replies are due:

1. A frame identical to the request is an echo, never a reply by itself.
2. A valid frame that answers the request is one of its replies, unless its node has replied in this turn already.
3. Any other valid frame is a stray: it answers nothing, and its node becomes doubtful.
4. Bytes that are not a valid frame cast doubt on the reply before them: with an 8-bit sum that reply may be what is left
   of another frame that was cut in two by accident. It is not believed; if it was the last reply that was due, the
   whole window is rejected. Before the first frame any bytes may be skipped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import Any, NamedTuple

from servobus.engine.job import Job
from servobus.engine.stats import Cause
from servobus.protocols.base import Codec, Reply, Request


@dataclass(slots=True, eq=False)
class Transmit:
    """What the engine wants done now: put a frame on the line."""

    frame: bytes
    deadline: float | None
    """When the missing replies count as missed; None: no reply is due."""


@dataclass(slots=True, eq=False)
class Turn(Transmit):
    """One request under way, and its job."""

    deadline: float
    request: Request[Any]
    job: Job
    sent_at: float
    """When its first byte left."""
    sent_by: float
    """When its last byte has left."""
    extended: bool = False
    """Its deadline was moved already."""
    replies: list[Any] = field(default_factory=list)
    echoes: int = 0
    skipped: int = -1
    """What the codec had skipped when the last frame was received; -1 before the first frame."""
    _torn: tuple[int, ...] = ()
    """Nodes whose reply was followed by bytes that are not a valid frame."""

    def offer(self, reply: Reply) -> bool:
        """Take a valid frame. False: it is a stray."""
        if reply.frame == self.request.frame and not self.request.mirrored:
            self.echoes += 1
            return True
        if len(self.replies) >= self.request.replies or not self.request.answers(reply):
            return False
        if reply.node in self._torn or any(earlier.node == reply.node for earlier in self.replies):
            return False
        self.replies.append(reply)
        return True

    def tear(self) -> None:
        """Give up the last reply: the bytes after it are not a valid frame."""
        if self.replies:
            self._torn = (*self._torn, self.replies.pop().node)

    def complete(self) -> bool:
        return len(self.replies) == self.request.replies

    def missing(self) -> list[int]:
        """Return the nodes whose reply has not come."""
        replied = {reply.node for reply in self.replies}
        return [node for node in self.request.nodes if node not in replied]

    def cause_of(self, stray: Reply) -> Cause:
        """Return why this turn has no value, where this came instead of a reply."""
        if stray.node not in self.request.nodes:
            return Cause.FOREIGN
        return Cause.NO_ANSWER if self.request.relayed and self.request.is_silence((stray,)) else Cause.LATE


class Window(Enum):
    """What the window of a turn holds."""

    OPEN = auto()
    """Replies are still due."""
    BELIEVED = auto()
    """All replies are here, and the window ends with a whole frame, or with the beginning of a reply to a later request."""
    REJECTED = auto()
    """All replies are here, but bytes that are not a valid frame follow them."""


class Verdict(NamedTuple):
    """The judgement of a window, and the strays found in it."""

    window: Window
    strays: tuple[Reply, ...] = ()


OPEN, BELIEVED, REJECTED = Verdict(Window.OPEN), Verdict(Window.BELIEVED), Verdict(Window.REJECTED)


def judge(codec: Codec, turn: Turn, following: Sequence[Turn] = ()) -> Verdict:
    """Judge what the codec holds, for the oldest turn under way and for those that follow it (full duplex)."""
    reply = codec.next_reply()
    if reply is None:
        return _verdict(codec, turn, (), following)
    request = turn.request
    if turn.skipped < 0 and not codec.pending and request.replies == 1 and request.answers(reply) and reply.frame != turn.frame:
        # Nearly always: the first frame is the one reply, and nothing follows it. The loop below finds the same.
        turn.replies.append(reply)
        turn.skipped = codec.skipped
        return BELIEVED
    strays: tuple[Reply, ...] = ()
    while reply is not None:
        if codec.skipped != turn.skipped:
            turn.tear()
            turn.skipped = codec.skipped
        if not (turn.offer(reply) or any(other.offer(reply) for other in following)):
            strays = (*strays, reply)
        reply = codec.next_reply()
    return _verdict(codec, turn, strays, following)


def _verdict(codec: Codec, turn: Turn, strays: tuple[Reply, ...], following: Sequence[Turn]) -> Verdict:
    if not turn.complete():
        window = Window.OPEN
    elif codec.skipped == turn.skipped and (following or not codec.pending):
        window = Window.BELIEVED
    else:
        window = Window.REJECTED
    return Verdict(window, strays)
