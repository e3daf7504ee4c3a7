"""A line inside this process: the bytes of the master go to a far end, and its replies come back."""

from __future__ import annotations

import asyncio

from servobus.errors import LinkDown, PortBusy, PortMissing
from servobus.links.base import FarEnd
from servobus.protocols.base import LineTraits


class MemoryLink:
    """A link to a far end; see `links.base.Link`. `unplug` and `plug` act as if a person did it to an adapter."""

    def __init__(self, far: FarEnd, traits: LineTraits, address: str = "sim:") -> None:
        self.traits = traits
        self.address = address
        self._far = far
        self._open: MemoryTransport | None = None
        self._plugged = True
        far.attach(self._deliver)

    async def connect(self, protocol: asyncio.Protocol) -> MemoryTransport:
        """Open the line. Raises PortMissing while it is unplugged, PortBusy while it is open."""
        await asyncio.sleep(0)  # lets a transport that was just closed report its connection_lost first
        if not self._plugged:
            raise PortMissing(f"{self.address} is unplugged: plug it in")
        if self._open is not None and not self._open.is_closing():
            raise PortBusy(f"{self.address} is open already: close it first")
        self._open = MemoryTransport(protocol, self._far, asyncio.get_running_loop())
        protocol.connection_made(self._open)
        return self._open

    def unplug(self) -> None:
        """End an open connection with LinkDown, and let nobody open another one."""
        self._plugged = False
        if self._open is not None:
            self._open.lose(LinkDown(f"{self.address} was unplugged: plug it in again"))

    def plug(self) -> None:
        """Let it be opened again."""
        self._plugged = True

    def _deliver(self, data: bytes) -> None:
        if self._open is not None:
            self._open.deliver(data)


class MemoryTransport(asyncio.Transport):
    """An open connection to a far end; see `links.base.Transport`."""

    def __init__(self, protocol: asyncio.Protocol, far: FarEnd, loop: asyncio.AbstractEventLoop) -> None:
        super().__init__()
        self._protocol = protocol
        self._far = far
        self._loop = loop
        self._closing = False

    def write(self, data: bytes | bytearray | memoryview) -> None:
        if not self._closing:
            self._far.receive(bytes(data))

    def deliver(self, data: bytes) -> None:
        if not self._closing:
            self._protocol.data_received(data)

    def poll_input(self) -> bool:
        """Return False: the loop delivers the bytes, and there is no buffer to read."""
        return False

    def set_baudrate(self, baudrate: int) -> None:
        self._far.set_baudrate(baudrate)

    def is_closing(self) -> bool:
        return self._closing

    def close(self) -> None:
        self.lose(None)

    def abort(self) -> None:
        self.lose(None)

    def lose(self, error: LinkDown | None) -> None:
        """Report `connection_lost` once, in a later pass of the loop."""
        if not self._closing:
            self._closing = True
            self._loop.call_soon(self._protocol.connection_lost, error)
