"""Through TCP, with and without TLS, on this machine's own address and a real loop."""

from __future__ import annotations

import asyncio
import ssl
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from servobus.errors import LinkDown
from servobus.remote.rig import connect
from tests.scripted_daemon import PuppetDaemon, Visitor


@asynccontextmanager
async def tcp_daemon(tls: ssl.SSLContext | None = None) -> AsyncIterator[tuple[PuppetDaemon, str]]:
    daemon = PuppetDaemon()
    daemon.answers["ping"] = {"result": 5}
    loop = asyncio.get_running_loop()
    server = await loop.create_server(lambda: Visitor(daemon), "127.0.0.1", 0, ssl=tls)
    try:
        yield daemon, f"tcp://127.0.0.1:{server.sockets[0].getsockname()[1]}"
    finally:
        server.close()
        for visitor in daemon.visitors:
            visitor.transport.abort()
        await asyncio.sleep(0)


async def test_tcp() -> None:
    async with tcp_daemon() as (daemon, address), connect(address, token="x" * 32) as rig:
        assert await rig.ping("s1") == 5
        assert daemon.calls("hello")[0]["token"] == "x" * 32
        daemon.visitor.transport.abort()
        with pytest.raises(LinkDown):
            await rig.ping("s1")


async def test_nobody_listens() -> None:
    async with tcp_daemon() as (_, address):
        pass
    with pytest.raises(LinkDown, match=r"no daemon listens at tcp://127.*servobus run"):
        async with connect(address):
            pass


async def test_tls(certificate: tuple[Path, Path]) -> None:
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.load_cert_chain(*certificate)
    async with tcp_daemon(context) as (_, address):
        async with connect(address, tls=certificate[0]) as rig:
            assert await rig.ping("s1") == 5
        with pytest.raises(LinkDown, match="certificate"):  # signed by nobody this machine knows
            async with connect(address, tls=True):
                pass


async def test_tls_with_a_daemon_that_has_none() -> None:
    async with tcp_daemon() as (daemon, address):
        daemon.answers.clear()
        with pytest.raises(LinkDown):
            async with connect(address, tls=True):
                pass
