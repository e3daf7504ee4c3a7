"""What a link is: it carries bytes to and from a line, and does not know what they mean.

A new link is one file with a class that fits `Link`, and one line in `SCHEMES` of this package.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Protocol

from servobus.protocols.base import LineTraits


class Transport(Protocol):
    """An open line with the methods of an asyncio transport.

    It calls the asyncio protocol that was passed to `connect`: `connection_made` once, `data_received` for what arrives, and
    `connection_lost` exactly once, with a LinkDown, or with None when this side closed the line.
    """

    def write(self, data: bytes) -> None:
        """Queue bytes. Never blocks, never raises, and never calls `data_received`."""

    def poll_input(self) -> bool:
        """Pass on what has already arrived; the engine asks for it before it declares a deadline missed.

        Returns False where the link cannot read outside of the loop.
        """

    def set_baudrate(self, baudrate: int) -> None:
        """Change the line's rate. Only where `traits.can_change_baud`."""

    def is_closing(self) -> bool: ...

    def close(self) -> None:
        """Send what is queued, then close."""

    def abort(self) -> None:
        """Close at once and discard what is queued; for use after an error."""


class Link(Protocol):
    """A way to reach a line. Opening it sends nothing."""

    @property
    def traits(self) -> LineTraits: ...

    @property
    def address(self) -> str:
        """The port as the config names it, for messages."""

    async def connect(self, protocol: asyncio.Protocol) -> Transport:
        """Open the line. Raises PortMissing, PortBusy, PortDenied or LinkDown, each with the next step."""


class FarEnd(Protocol):
    """The other end of a line that exists in this process: simulated devices, or a fault injector in front of them."""

    def attach(self, deliver: Callable[[bytes], None]) -> None:
        """Take the function that passes bytes to the master. `receive` never calls it directly."""

    def receive(self, data: bytes) -> None:
        """Take bytes that the master sent."""

    def set_baudrate(self, baudrate: int) -> None:
        """The master sends and listens at this rate from now on."""
