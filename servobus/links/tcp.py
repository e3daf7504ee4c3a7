"""Raw bytes over TCP, to a serial device server or ser2net."""

from __future__ import annotations

import asyncio
import errno
import os
import socket
from functools import partial
from typing import cast

from servobus.errors import LinkDown
from servobus.protocols.base import LineTraits

CONNECT_TIMEOUT = 2.0
LATENCY = 0.020
"""Seconds a server may collect bytes before it passes them on."""
MAX_UNSENT = 64 * 1024
"""Bytes that may wait for the server. It counts as gone when more wait."""
OPTIONS = (
    (socket.IPPROTO_TCP, socket.TCP_NODELAY, 1),
    (socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1),
    (socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 5),
    (socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 1),
    (socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 3),
)
"""Send each byte at once, and notice within 8 s that the server has disappeared, even if the line is idle."""
REASONS = {
    errno.ECONNREFUSED: "no program listens there: check the port number, and whether the server is on",
    errno.EHOSTUNREACH: "there is no route to it: check the address and the cable",
    errno.ENETUNREACH: "there is no route to it: check the address and this machine's network",
}


class TcpLink:
    """A TCP address; see `links.base.Link`."""

    def __init__(self, host: str, port: int, baudrate: int) -> None:
        """`baudrate`: the rate that is set at the server. Deadlines use it; it is not sent to the server."""
        self.address = f"tcp://[{host}]:{port}" if ":" in host else f"tcp://{host}:{port}"
        self.traits = LineTraits(baudrate, latency=LATENCY)
        self._host = host
        self._port = port

    async def connect(self, protocol: asyncio.Protocol) -> TcpTransport:
        """Connect to the server. Raises LinkDown."""
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(CONNECT_TIMEOUT):
                _, adapter = await loop.create_connection(partial(TcpTransport, protocol, self.address), self._host, self._port)
        except OSError as error:
            raise explain_connect_error(self.address, error) from None
        return adapter


def explain_connect_error(address: str, error: OSError) -> LinkDown:
    """Return an error that says what the system's error means and what to do."""
    if isinstance(error, TimeoutError):
        return LinkDown(f"{address} does not answer: check the address, and whether the server is on")
    if isinstance(error, socket.gaierror):
        return LinkDown(f"{address}: this machine knows no such host ({error.strerror}): check the name, or write the address")
    if error.errno in REASONS:
        return LinkDown(f"{address}: {REASONS[error.errno]}")
    reason = os.strerror(error.errno) if error.errno else error
    return LinkDown(f"{address} cannot be reached ({reason}): check host, port and server")


class SocketTransport(asyncio.Protocol):
    """What links over TCP share: adds to the socket's transport what it lacks, and translates its errors."""

    def __init__(self, protocol: asyncio.Protocol, address: str) -> None:
        self._protocol = protocol
        self._address = address
        self._error: LinkDown | None = LinkDown(f"{address} closed the connection: it is opened again")
        """The error to report when the connection ends."""
        self._socket: asyncio.Transport

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._socket = cast("asyncio.Transport", transport)  # uvloop's transport has the methods, but not the base class
        for level, option, value in OPTIONS:
            transport.get_extra_info("socket").setsockopt(level, option, value)

    def connection_lost(self, exc: Exception | None) -> None:
        if self._error is not None and exc is not None:
            self._error = LinkDown(f"{self._address} was lost ({exc}): it is opened again")
        self._protocol.connection_lost(self._error)

    def poll_input(self) -> bool:
        """Return False: only the loop can read the socket."""
        return False

    def set_baudrate(self, baudrate: int) -> None:
        """Do nothing: the traits of these links do not allow a change."""

    def is_closing(self) -> bool:
        return self._socket.is_closing()

    def close(self) -> None:
        self._error = None
        self._socket.close()

    def abort(self) -> None:
        self.lose(None)

    def lose(self, error: LinkDown | None) -> None:
        """Close at once, and report this error."""
        self._error = error
        self._socket.abort()


class TcpTransport(SocketTransport):
    """An open connection; see `links.base.Transport`."""

    def __init__(self, protocol: asyncio.Protocol, address: str) -> None:
        super().__init__(protocol, address)
        # Saves one call per chunk. It is set here because uvloop reads the attribute before it calls connection_made.
        self.data_received = protocol.data_received  # type: ignore[method-assign]

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self._protocol.connection_made(self)  # type: ignore[arg-type]  # has a transport's methods, but not its base class

    def write(self, data: bytes) -> None:
        if self._socket.is_closing():
            return
        self._socket.write(data)
        if self._socket.get_write_buffer_size() > MAX_UNSENT:
            self.lose(LinkDown(f"{self._address} takes no more bytes: is the server alive?"))
