"""Raw bytes over TCP: a serial device server, or ser2net."""

from __future__ import annotations

import asyncio
import socket

from servobus.errors import LinkDown
from servobus.protocols.base import LineTraits

CONNECT_TIMEOUT = 2.0
LATENCY = 0.020
"""Seconds a server may collect bytes before it sends them on."""
KEEPALIVE = {"TCP_KEEPIDLE": 5, "TCP_KEEPINTVL": 1, "TCP_KEEPCNT": 3}
"""A peer that is gone without a word is noticed within 8 s, even if nothing is asked of it."""


class TcpLink:
    """See `links.base.Link`. `baudrate`: what the server speaks on its line, for deadlines; it is set there."""

    def __init__(self, host: str, port: int, baudrate: int) -> None:
        self.address = f"tcp://{host}:{port}"
        self.traits = LineTraits(baudrate, latency=LATENCY)
        self._host = host
        self._port = port

    async def connect(self, protocol: asyncio.Protocol) -> TcpTransport:
        """Raises LinkDown."""
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(CONNECT_TIMEOUT):
                _, adapter = await loop.create_connection(lambda: TcpTransport(protocol, self.address), self._host, self._port)
        except TimeoutError:
            raise LinkDown(f"{self.address} does not answer: is the server on, is the address right?") from None
        except OSError as error:
            raise LinkDown(f"{self.address} cannot be reached ({error.strerror or error}): check host, port and server") from None
        return adapter


class TcpTransport(asyncio.Protocol):
    """See `links.base.Transport`: the socket's transport, with the one method it lacks and errors in our words."""

    def __init__(self, protocol: asyncio.Protocol, address: str) -> None:
        self._protocol = protocol
        self._address = address
        self._closed_by_us = False
        self._socket: asyncio.Transport

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._socket = transport
        sock = transport.get_extra_info("socket")
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in KEEPALIVE.items():
            sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
        self._protocol.connection_made(self)  # type: ignore[arg-type]
        self.data_received = self._protocol.data_received  # type: ignore[method-assign]

    def connection_lost(self, exc: Exception | None) -> None:
        error = None if self._closed_by_us else LinkDown(f"{self._address} closed the connection ({exc or 'end of file'}): it is opened again")
        self._protocol.connection_lost(error)

    def write(self, data: bytes) -> None:
        self._socket.write(data)

    def look(self) -> bool:
        """The loop reads the socket."""
        return False

    def set_baudrate(self, baudrate: int) -> None:
        """Never called: the traits say that it cannot."""

    def is_closing(self) -> bool:
        return self._socket.is_closing()

    def close(self) -> None:
        self._closed_by_us = True
        self._socket.close()

    def abort(self) -> None:
        self._closed_by_us = True
        self._socket.abort()
