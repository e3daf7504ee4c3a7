"""The door on TCP, from outside: TLS to the end, and whoever comes without a word is not kept."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

import servobus
from servobus.config.access import TcpOptions, TlsOptions
from servobus.errors import AccessDenied, ConfigError
from tests.daemon.raw_client import served
from tests.daemon.test_access import TOKEN, token_file

PATIENCE = 0.05
Certificate = tuple[Path, Path]


def tcp(folder: Path, certificate: Certificate | None = None) -> TcpOptions:
    tls = None if certificate is None else TlsOptions(certificate=str(certificate[0]), key=str(certificate[1]))
    return TcpOptions(port=0, token_file=str(token_file(folder)), tls=tls)


async def test_a_rig_through_tls(tmp_path: Path, certificate: Certificate) -> None:
    async with served(tmp_path, tcp=tcp(tmp_path, certificate)) as (_, door, _):
        address = door.addresses[1]
        async with servobus.connect(address, token=TOKEN, tls=certificate[0]) as rig:
            await rig.enable("s1")
            await rig.move({"s1": 10})
            assert (await rig.settle("s1"))["arm/s1"].position == pytest.approx(10, abs=0.2)
            await rig.disable("s1")
        with pytest.raises(AccessDenied, match="token"):
            async with servobus.connect(address, token=TOKEN[::-1], tls=certificate[0]):
                pass


@pytest.mark.parametrize("secret", [False, True])
async def test_who_says_nothing_is_not_kept(secret: bool, tmp_path: Path, certificate: Certificate) -> None:
    """Neither before the handshake of TLS nor before the token."""
    async with served(tmp_path, handshake=PATIENCE, tcp=tcp(tmp_path, certificate if secret else None)) as (_, door, _):
        port = int(door.addresses[1].rpartition(":")[2])
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        async with asyncio.timeout(20):
            assert await reader.read() == b""
        writer.close()
        assert not door.connections


async def test_a_certificate_that_cannot_be_used(tmp_path: Path, certificate: Certificate) -> None:
    with pytest.raises(ConfigError, match=r"door\.tcp\.tls: certificate and key cannot be used"):
        async with served(tmp_path, tcp=tcp(tmp_path, (certificate[1], certificate[0]))):
            pass


async def test_a_port_that_is_taken(tmp_path: Path) -> None:
    taken = await asyncio.start_server(lambda *_: None, "127.0.0.1", 0)
    async with taken:
        port = taken.sockets[0].getsockname()[1]
        options = tcp(tmp_path).model_copy(update={"port": port})
        with pytest.raises(ConfigError, match=rf"127\.0\.0\.1:{port} cannot be listened at .*in use"):
            async with served(tmp_path, tcp=options):
                pass
