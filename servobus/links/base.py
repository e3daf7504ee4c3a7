"""What a link is: how bytes reach a line, and nothing about what they mean."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Protocol

from servobus.protocols.base import LineTraits


class Transport(Protocol):
    """An open line, in the shape of an asyncio transport. The asyncio protocol given to `connect` hears it:
    `connection_made`, `data_received`, and exactly one `connection_lost` (with a LinkDown, or None when closed by us)."""

    def write(self, data: bytes) -> None:
        """Queue bytes; never blocks, never raises. `data_received` is never called from within."""

    def poll_input(self) -> bool:
        """Hand over now what already arrived; before a deadline is declared missed. False: this link cannot look."""

    def set_baudrate(self, baudrate: int) -> None:
        """Where `traits.can_change_baud`."""

    def is_closing(self) -> bool: ...

    def close(self) -> None:
        """Leave in order: what is queued still goes out."""

    def abort(self) -> None:
        """Leave at once: the way after any error."""


class Link(Protocol):
    """A way to a line. Opening it sends nothing."""

    @property
    def traits(self) -> LineTraits: ...

    @property
    def address(self) -> str:
        """What a person wrote in the config: for messages."""

    async def connect(self, protocol: asyncio.Protocol) -> Transport:
        """Open the line. Raises PortMissing, PortBusy, PortDenied or LinkDown, which say what to do."""


class FarEnd(Protocol):
    """The other end of a line that exists only here: simulated devices, or a fault injector before them."""

    def attach(self, deliver: Callable[[bytes], None]) -> None:
        """`deliver` takes what the line says to the master. Never called from within `receive`."""

    def receive(self, data: bytes) -> None:
        """The master said this."""

    def set_baudrate(self, baudrate: int) -> None:
        """The master now speaks and listens at this rate."""
