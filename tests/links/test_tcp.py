"""Raw TCP against real servers on this machine."""

from __future__ import annotations

import asyncio
import errno
import socket
import struct
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from servobus.errors import LinkDown
from servobus.links.tcp import LATENCY, TcpLink, explain_connect_error
from servobus.protocols.base import LineTraits
from tests.links.recorder import PATIENCE, Receiver, on_each_loop


class Server:
    """One connection."""

    def __init__(self) -> None:
        self.port = 0
        self.reader: asyncio.StreamReader
        self.writer: asyncio.StreamWriter
        self._connected = asyncio.Event()

    def accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer
        self._connected.set()

    async def connected(self) -> None:
        async with asyncio.timeout(PATIENCE):
            await self._connected.wait()


@asynccontextmanager
async def serving() -> AsyncIterator[Server]:
    server = Server()
    listener = await asyncio.start_server(server.accept, "127.0.0.1", 0)
    server.port = listener.sockets[0].getsockname()[1]
    try:
        yield server
    finally:
        listener.close()
        if hasattr(server, "writer"):
            server.writer.transport.abort()
        await asyncio.sleep(0)


@on_each_loop
async def test_both_ways() -> None:
    receiver = Receiver()
    async with serving() as server:
        transport = await TcpLink("127.0.0.1", server.port, 115_200).connect(receiver)
        assert receiver.made == 1
        await server.connected()
        transport.write(b"question")
        assert await server.reader.readexactly(8) == b"question"
        server.writer.write(b"answer")
        assert await receiver.until(6) == b"answer"
        assert not transport.poll_input()
        transport.abort()
        assert await receiver.gone() is None


@on_each_loop
async def test_the_server_closes() -> None:
    receiver = Receiver()
    async with serving() as server:
        transport = await TcpLink("127.0.0.1", server.port, 115_200).connect(receiver)
        await server.connected()
        server.writer.close()
        error = await receiver.gone()
        assert isinstance(error, LinkDown)
        assert str(error) == f"tcp://127.0.0.1:{server.port} closed the connection: it is opened again"
        assert transport.is_closing()
        for _ in range(10):
            transport.write(b"nobody")
        assert await receiver.gone() is error


@on_each_loop
async def test_the_connection_breaks() -> None:
    """A server that is reset sends RST."""
    receiver = Receiver()
    async with serving() as server:
        await TcpLink("127.0.0.1", server.port, 115_200).connect(receiver)
        await server.connected()
        server.writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        server.writer.transport.abort()
        error = await receiver.gone()
        assert isinstance(error, LinkDown)
        assert str(error).startswith(f"tcp://127.0.0.1:{server.port} was lost (")
        assert str(error).endswith("): it is opened again")


@on_each_loop
async def test_a_close_sends_everything() -> None:
    receiver, much = Receiver(), bytes(30_000)
    async with serving() as server:
        transport = await TcpLink("127.0.0.1", server.port, 115_200).connect(receiver)
        await server.connected()
        transport.write(much)
        transport.close()
        transport.write(b"too late")
        assert await server.reader.read() == much
        assert await receiver.gone() is None


@on_each_loop
async def test_what_waits_for_the_server_is_bounded() -> None:
    """It reads nothing: the connection is given up, however much the system itself is ready to keep."""
    receiver = Receiver()
    async with serving() as server:
        transport = await TcpLink("127.0.0.1", server.port, 115_200).connect(receiver)
        await server.connected()
        server.writer.transport.pause_reading()  # type: ignore[attr-defined]  # a stream's transport reads as well
        for _ in range(100_000):
            transport.write(bytes(1000))
            await asyncio.sleep(0)
            if transport.is_closing():
                break
        error = await receiver.gone()
        assert isinstance(error, LinkDown)
        assert "takes no more bytes: is the server alive?" in str(error)


@on_each_loop
async def test_nobody_listens() -> None:
    receiver = Receiver()
    with socket.socket() as reserved:  # bound, but it does not listen
        reserved.bind(("127.0.0.1", 0))
        port = reserved.getsockname()[1]
        with pytest.raises(LinkDown, match=f"tcp://127.0.0.1:{port}: no program listens there: check the port number"):
            await TcpLink("127.0.0.1", port, 115_200).connect(receiver)
    assert (receiver.made, receiver.lost) == (0, [])


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (TimeoutError(), "tcp://server:23 does not answer: check the address, and whether the server is on"),
        (TimeoutError(errno.ETIMEDOUT, "timed out"), "tcp://server:23 does not answer"),
        (socket.gaierror(-2, "Name or service not known"), "knows no such host (Name or service not known): check the name"),
        (OSError(errno.EHOSTUNREACH, "Connect call failed"), "there is no route to it: check the address and the cable"),
        (
            OSError(errno.ENETUNREACH, "Connect call failed"),
            "there is no route to it: check the address and this machine's network",
        ),
        (
            PermissionError(errno.EACCES, "Connect call failed"),
            "cannot be reached (Permission denied): check host, port and server",
        ),
        (OSError("Multiple exceptions: ..."), "cannot be reached (Multiple exceptions: ...): check host"),
    ],
)
def test_what_the_system_may_say(error: OSError, text: str) -> None:
    link_down = explain_connect_error("tcp://server:23", error)
    assert str(link_down).startswith("tcp://server:23")
    assert text in str(link_down)


def test_traits_and_address() -> None:
    """The rate is the server's business: it counts for deadlines, and bytes need not take their time."""
    link = TcpLink("::1", 4001, 115_200)
    assert link.address == "tcp://[::1]:4001"
    assert TcpLink("server", 23, 9_600).address == "tcp://server:23"
    assert link.traits == LineTraits(115_200, latency=LATENCY)
