"""The commands of KST RS422, 3, as requests that know their reply.

A reply names its servo and the command that it answers. So replies can only be confused if they answer the same command: that is
the `reply_key`. An echo is never taken for a reply, because their codes differ.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import TypeVar, cast

from servobus.errors import EchoMismatch
from servobus.protocols.base import Request
from servobus.protocols.kst.aborts import AbortReader
from servobus.protocols.kst.codec import REFUSED, REPLY, SAVE_DATA, SIZE, VERSION, Command, Frame, encode, name_of
from servobus.protocols.kst.options import KstBus

R = TypeVar("R")

TURNAROUND = 0.005
"""Seconds within which a reply that is not needed is expected to begin; the document gives no time."""


@dataclass(frozen=True, slots=True)
class RequestSettings:
    """What all requests of a bus share. Times in seconds."""

    aborts: AbortReader = field(default_factory=AbortReader)
    version: int = VERSION
    gap: float = 0.0
    """Silence after each reply."""
    guard: float = SIZE * 10 / 512_000 + TURNAROUND
    """Silence after a command whose reply is not waited for: long enough for a reply that comes nevertheless."""
    flash_time: float = 0.2
    """How long a servo needs to write its flash."""
    strict_echo: bool = True

    @classmethod
    def of(cls, options: KstBus) -> RequestSettings:
        return cls(
            AbortReader(options.sdo_order),
            options.version_byte,
            options.min_gap_us / 1e6,
            SIZE * 10 / options.baudrate + TURNAROUND,
            options.save_settle_ms / 1000,
            options.echo_check == "strict",
        )


class KstRequest(Request[R]):
    """A command to one servo, answered by one frame."""

    def __init__(self, settings: RequestSettings, node: int, command: int, data: bytes = b"") -> None:
        self.settings = settings
        self.node = node
        self.command = command
        self.data = data
        self.frame = encode(node, command, data, settings.version)
        self.nodes = (node,)
        self.reply_size = SIZE
        self.reply_key: int = command
        self.quiet_after = settings.gap

    def answers(self, reply: Frame) -> bool:
        return reply.address == self.node and reply.code in (REPLY + self.command, REFUSED + self.command)

    def parse(self, replies: Sequence[Frame]) -> R:
        if not replies:
            return cast("R", None)
        reply = replies[0]
        if reply.refused:
            raise self.settings.aborts.error(reply.address, name_of(self.command), reply.data, request=self, raw=reply.frame)
        return self.decode(reply)

    def decode(self, reply: Frame) -> R:
        """Return the value of a reply that is not a refusal. The default is for requests without one."""
        return cast("R", None)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.frame.hex(' ')})"


class Read(KstRequest[R]):
    """Read id, position, status or version (KST RS422, 3.4, 3.6 to 3.8)."""

    changes = False

    def __init__(
        self, settings: RequestSettings, node: int, command: Command, make: Callable[[bytes], R], *, once: bool = False
    ) -> None:
        """`make`: returns the value in the eight data bytes. `once`: it is not repeated when no reply comes."""
        super().__init__(settings, node, command)
        self.idempotent = not once
        self._make = make

    def decode(self, reply: Frame) -> R:
        return self._make(reply.data)


class Fence(KstRequest[None]):
    """A read whose reply, also a refusal, shows that all earlier replies have left the servo.

    It is not repeated: the next fence needs another command, or this one's late reply could answer it.
    """

    changes = False
    idempotent = False

    def __init__(self, settings: RequestSettings, node: int, command: Command, ids: Collection[int]) -> None:
        """`ids`: the ids that the servo may report as its own."""
        super().__init__(settings, node, command)
        self._ids = ids

    def answers(self, reply: Frame) -> bool:
        own = reply.refused or self.command != Command.READ_ID or reply.data[0] in self._ids
        return own and super().answers(reply)

    def parse(self, replies: Sequence[Frame]) -> None:
        """Accept any reply."""


class SetValue(KstRequest[None]):
    """A set command, whose reply repeats its data (KST RS422, 3.1, 3.2, 3.5)."""

    changes = True

    def __init__(self, settings: RequestSettings, node: int, command: Command, data: bytes, *, also: int | None = None) -> None:
        """`also`: another address from which the reply may come."""
        super().__init__(settings, node, command, data)
        self.idempotent = command == Command.SET_POSITION
        self._also = also

    def answers(self, reply: Frame) -> bool:
        if self._also is not None and reply.address == self._also:
            return reply.code == REPLY + self.command
        return super().answers(reply)

    def decode(self, reply: Frame) -> None:
        repeated = reply.data[: len(self.data)]
        if self.settings.strict_echo and repeated != self.data:
            raise EchoMismatch(
                f"{name_of(self.command)}: {repeated.hex(' ')} was confirmed, {self.data.hex(' ')} was sent: read it back before "
                "the next one (echo_check: off accepts it)",
                request=self,
                raw=reply.frame,
            )


class Save(KstRequest[None]):
    """Save, where a reply is waited for (KST RS422, 3.3). Never repeated, because it wears the flash."""

    idempotent = False
    changes = True

    def __init__(self, settings: RequestSettings, node: int) -> None:
        super().__init__(settings, node, Command.SAVE, SAVE_DATA)
        self.service_time = self.quiet_after = settings.flash_time


class UnansweredCommand(KstRequest[None]):
    """A command whose reply is not waited for; the line stays silent as long as a reply would take."""

    replies = 0

    def __init__(self, settings: RequestSettings, node: int, command: Command, data: bytes = b"") -> None:
        super().__init__(settings, node, command, data)
        self.nodes = ()
        self.idempotent = command == Command.SET_POSITION
        self.quiet_after = max(settings.guard, settings.flash_time if command == Command.SAVE else 0.0)
