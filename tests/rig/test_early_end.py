"""A server that takes the connection and hangs up: one event, growing pauses, and its greeting is shown."""

from __future__ import annotations

import asyncio

import pytest

from servobus.rig.local import open_rig
from tests.simulated_rigs import config

pytestmark = pytest.mark.slow

GREETINGS = {
    b"SSH-2.0-OpenSSH_9.2\r\n": "SSH-2.0-OpenSSH_9.2",
    b"\xff\xfd\x18\xff\xfb\x01": "telnet",
    b"": "another kind of server",
}


@pytest.mark.parametrize("greeting", GREETINGS)
async def test_a_server_that_hangs_up_is_one_event(greeting: bytes, caplog: pytest.LogCaptureFixture) -> None:
    connections = 0
    fifth = asyncio.Event()

    async def hang_up(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal connections
        connections += 1
        writer.write(greeting)
        await writer.drain()
        writer.close()
        if connections == 5:
            fifth.set()

    server = await asyncio.start_server(hang_up, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    async with server, open_rig(config(port=f"tcp://127.0.0.1:{port}"), degraded=True):
        async with asyncio.timeout(10):
            await fifth.wait()
    lines = [record.getMessage() for record in caplog.records]
    (reason,) = [line for line in lines if "waiting_for_port" in line]
    assert GREETINGS[greeting] in reason
    assert len([line for line in lines if "line_down" in line]) == 1
