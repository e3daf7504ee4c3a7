"""Simulated buses as other programs use them: names, paths, rates, faults, and the end."""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
import serial

from servobus.protocols.sms.codec import BROADCAST_ID, Instruction, encode
from servobus.protocols.sms.model import packaged_models
from servobus.protocols.sms.options import SmsBus
from servobus.simulation.serve import serve


def bus(baudrate: int = 1_000_000, *ids: int, **keys: object) -> SmsBus:
    servos = {f"s{node}": {"id": node, "model": "sts"} for node in ids or (1,)}
    return SmsBus.model_validate({"protocol": "sms", "port": "sim:", "baudrate": baudrate, "servos": servos, **keys})


@asynccontextmanager
async def served(buses: Mapping[str, SmsBus], folder: Path | None = None) -> AsyncIterator[dict[str, str]]:
    """Path by name, while it serves."""
    loop = asyncio.get_running_loop()
    complete: asyncio.Future[None] = loop.create_future()
    paths: dict[str, str] = {}

    def announce(name: str, path: str) -> None:
        paths[name] = path
        if len(paths) == len(buses):
            complete.set_result(None)

    task = asyncio.create_task(serve(buses, dict.fromkeys(buses, packaged_models()), announce, folder=folder))
    await asyncio.wait([task, complete], return_when=asyncio.FIRST_COMPLETED)
    try:
        assert complete.done(), task
        yield paths
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        assert task.cancelled()


async def ask(port: serial.Serial, frame: bytes, size: int) -> bytes:
    """The next `size` bytes after saying `frame`."""
    loop = asyncio.get_running_loop()
    received = bytearray()
    done = asyncio.Event()

    def read() -> None:
        received.extend(os.read(port.fileno(), 4096))
        if len(received) >= size:
            done.set()

    loop.add_reader(port.fileno(), read)
    try:
        port.write(frame)
        async with asyncio.timeout(10):
            await done.wait()
    finally:
        loop.remove_reader(port.fileno())
    return bytes(received)


async def test_each_bus_has_its_own_port() -> None:
    """In the order of the config, and each with its own servos at its own rate, custom ones too."""
    async with served({"arm": bus(1_000_000, 1), "leg": bus(76_800, 2)}) as paths:
        assert list(paths) == ["arm", "leg"]
        for name, rate, node in (("arm", 1_000_000, 1), ("leg", 76_800, 2)):
            with serial.Serial(paths[name], rate) as port:
                everybody = encode(BROADCAST_ID, Instruction.PING)
                assert await ask(port, everybody, 6) == encode(node, 0)


async def test_a_servo_follows_its_baud_register() -> None:
    """It replies at the old rate, then receives only at the new one."""
    async with served({"arm": bus(1_000_000, 1, 2)}) as paths, asyncio.timeout(10):
        with serial.Serial(paths["arm"], 1_000_000) as port:
            assert await ask(port, encode(1, Instruction.WRITE, b"\x06\x04"), 6) == encode(1, 0)
            question = encode(1, Instruction.PING)
            assert await ask(port, question + encode(2, Instruction.PING), 6) == encode(2, 0)
            port.baudrate = 115_200
            assert await ask(port, question, 6) == encode(1, 0)


async def test_servos_remember_when_users_go() -> None:
    """What one user wrote, the next one reads."""
    async with served({"arm": bus()}) as paths:
        with serial.Serial(paths["arm"], 1_000_000) as port:
            await ask(port, encode(1, Instruction.WRITE, b"\x2e\x07\x00"), 6)
        with serial.Serial(paths["arm"], 1_000_000) as port:
            assert await ask(port, encode(1, Instruction.READ, b"\x2e\x01"), 7) == encode(1, 0, b"\x07")


async def test_faults_apply() -> None:
    """As they do in one process."""
    async with served({"arm": bus(faults={"duplicate": 1.0})}) as paths:
        with serial.Serial(paths["arm"], 1_000_000) as port:
            assert await ask(port, encode(1, Instruction.PING), 12) == 2 * encode(1, 0)


async def test_names_in_a_folder_last_as_long_as_it_serves(tmp_path: Path) -> None:
    """A link for each bus, gone at the end."""
    async with served({"arm": bus(), "leg": bus()}, tmp_path) as paths:
        assert paths == {"arm": str(tmp_path / "arm"), "leg": str(tmp_path / "leg")}
        with serial.Serial(paths["leg"], 1_000_000) as port:
            assert await ask(port, encode(1, Instruction.PING), 6) == encode(1, 0)
        devices = {os.readlink(path) for path in paths.values()}
    assert os.listdir(tmp_path) == []
    assert len(devices) == 2


async def test_nothing_is_announced_where_a_file_is_in_the_way(tmp_path: Path) -> None:
    """The file stays, and the bus before it is closed again."""
    (tmp_path / "leg").write_text("data")
    announced: list[str] = []
    buses = {"arm": bus(), "leg": bus()}
    with pytest.raises(FileExistsError, match="leg is not a symlink"):
        await serve(buses, dict.fromkeys(buses, packaged_models()), lambda name, path: announced.append(name), folder=tmp_path)
    assert (announced, os.listdir(tmp_path)) == ([], ["leg"])
