"""The commands of the seed's section 3 as requests that know their reply.

A reply names its servo and the command it answers, so the replies that can be mistaken for each other are those to the same
command: that is the `reply_key`. An own request heard back is never taken for a reply, because the codes differ.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

from servobus.errors import EchoMismatch, NotSupported
from servobus.protocols.base import Request
from servobus.protocols.kst.aborts import AbortReader
from servobus.protocols.kst.codec import BROADCAST, REFUSED, REPLY, SAVE_WORD, SIZE, VERSION, Command, Frame, encode, name_of
from servobus.protocols.kst.options import KstBus

R = TypeVar("R")

TURNAROUND = 0.005
"""Seconds within which a servo that answers without need is expected to begin; the documents name no time."""


@dataclass(frozen=True, slots=True)
class FrameTiming:
    """What every request of a bus has in common."""

    aborts: AbortReader = field(default_factory=AbortReader)
    version: int = VERSION
    gap: float = 0.0
    """Seconds of silence after each answer."""
    guard: float = SIZE * 10 / 512_000 + TURNAROUND
    """Seconds of silence after what is not answered: time for an answer that comes nevertheless."""
    settle: float = 0.2
    """Seconds a servo needs for its flash."""
    strict_echo: bool = True

    @classmethod
    def of(cls, options: KstBus) -> FrameTiming:
        return cls(
            AbortReader(options.sdo_order),
            options.version_byte,
            options.min_gap_us / 1e6,
            SIZE * 10 / options.baudrate + TURNAROUND,
            options.save_settle_ms / 1000,
            options.echo_check == "strict",
        )


class KstRequest(Request[R]):
    """A command that is answered by one frame."""

    def __init__(self, timing: FrameTiming, node: int, command: int, data: bytes = b"") -> None:
        self.timing = timing
        self.node = node
        self.command = command
        self.data = data
        self.frame = encode(node, command, data, timing.version)
        self.nodes = (node,) if node != BROADCAST else ()
        self.reply_size = SIZE
        self.reply_key: int = command
        self.quiet_after = timing.gap

    def answers(self, reply: Frame) -> bool:
        return reply.address == self.node and reply.code in (REPLY + self.command, REFUSED + self.command)

    def parse(self, replies: Sequence[Frame]) -> R:
        reply = replies[0]
        if reply.refused:
            raise self.timing.aborts.error(reply.address, name_of(self.command), reply.data, request=self, raw=reply.frame)
        return self.decode(reply)

    @abstractmethod
    def decode(self, reply: Frame) -> R:
        """The value of a reply that is no refusal."""

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.frame.hex(' ')})"


class Read(KstRequest[R]):
    """Read id, position, status or version (3.4, 3.6 to 3.8); `make` makes the value of the eight data bytes."""

    def __init__(
        self, timing: FrameTiming, node: int, command: Command, make: Callable[[bytes], R], *, once: bool = False
    ) -> None:
        """`once`: not said again when no answer comes."""
        super().__init__(timing, node, command)
        self.idempotent = not once
        self._make = make

    def decode(self, reply: Frame) -> R:
        return self._make(reply.data)


class Fence(KstRequest[None]):
    """A read whose answer shows that all earlier ones have left the servo; a refusal shows that as well. Not repeated: the next
    fence has another command, or its answer could be that of this one."""

    idempotent = False

    def __init__(self, timing: FrameTiming, node: int, command: Command, ids: Collection[int]) -> None:
        """`ids`: what the servo may say its id is."""
        super().__init__(timing, node, command)
        self._ids = ids

    def answers(self, reply: Frame) -> bool:
        own = reply.refused or self.command != Command.READ_ID or reply.data[0] in self._ids
        return own and super().answers(reply)

    def parse(self, replies: Sequence[Frame]) -> None:
        """Any answer will do."""

    def decode(self, reply: Frame) -> None:
        """It has no value."""


class Confirmed(KstRequest[None]):
    """A set: its reply brings back what was sent (3.1, 3.2, 3.5)."""

    def __init__(self, timing: FrameTiming, node: int, command: Command, data: bytes, *, also: int | None = None) -> None:
        """`also`: another address the answer may come from."""
        super().__init__(timing, node, command, data)
        self.idempotent = command == Command.SET_POSITION
        self._also = also

    def answers(self, reply: Frame) -> bool:
        if self._also is not None and reply.address == self._also:
            return reply.code == REPLY + self.command
        return super().answers(reply)

    def decode(self, reply: Frame) -> None:
        heard = reply.data[: len(self.data)]
        if self.timing.strict_echo and heard != self.data:
            raise EchoMismatch(
                f"{name_of(self.command)}: {heard.hex(' ')} was confirmed, {self.data.hex(' ')} was sent: read it back before "
                "the next one (echo_check: off believes it)",
                request=self,
                raw=reply.frame,
            )


class Save(KstRequest[None]):
    """Save (3.3), where an answer is waited for. Wears the flash, so it is never repeated."""

    idempotent = False

    def __init__(self, timing: FrameTiming, node: int) -> None:
        super().__init__(timing, node, Command.SAVE, SAVE_WORD)
        self.service_time = self.quiet_after = timing.settle

    def decode(self, reply: Frame) -> None:
        """Whatever it brings: the seed knows no data of it."""


class Tell(KstRequest[None]):
    """A command whose answer nobody waits for; the line stays silent for the time that one would take."""

    replies = 0

    def __init__(self, timing: FrameTiming, node: int, command: Command, data: bytes = b"") -> None:
        super().__init__(timing, node, command, data)
        self.nodes = ()
        self.idempotent = command == Command.SET_POSITION
        self.quiet_after = max(timing.guard, timing.settle if command == Command.SAVE else 0.0)

    def parse(self, replies: Sequence[Frame]) -> None:
        """It has no answer."""

    def decode(self, reply: Frame) -> None:
        """It has no answer."""


class Broadcast(KstRequest[Frame | None]):
    """A command to all. Waits for no answer, unless the config says that the only servo of the line gives one. Raises
    NotSupported for what must not be said to all."""

    idempotent = False

    def __init__(self, timing: FrameTiming, options: KstBus, command: Command, data: bytes = b"") -> None:
        if command not in options.broadcast_allow:
            raise NotSupported(
                f"{name_of(command)} is not said to all, for every servo would obey or answer at once: name one, or see "
                "broadcast_allow"
            )
        super().__init__(timing, BROADCAST, command, data)
        if options.broadcast_reply == "ignore":
            self.replies = 0
            self.quiet_after = timing.guard

    def answers(self, reply: Frame) -> bool:
        """From whatever address."""
        return reply.code in (REPLY + self.command, REFUSED + self.command)

    def parse(self, replies: Sequence[Frame]) -> Frame | None:
        return super().parse(replies) if replies else None

    def decode(self, reply: Frame) -> Frame:
        return reply
