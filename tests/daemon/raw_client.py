"""A client that says any bytes, as `nc -U` would, and a door to say them to."""

from __future__ import annotations

import asyncio
import itertools
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from servobus.config.access import DoorOptions
from servobus.config.loader import Config
from servobus.daemon.server import HANDSHAKE, NativeDoor
from servobus.rig.local import LocalRig, open_rig
from tests.daemon_in_process import open_test_door
from tests.simulated_rigs import config


class Raw:
    """`call` waits for its own answer; notifications are kept in `told`."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader = reader
        self.writer = writer
        self.notices: list[Any] = []
        self._numbers = itertools.count(1)

    def say(self, data: bytes) -> None:
        self.writer.write(data)

    async def line(self) -> Any:
        """The next one; None at the end."""
        async with asyncio.timeout(20):
            line = await self.reader.readline()
        return json.loads(line) if line else None

    def ask(self, method: str, **params: Any) -> int:
        number = next(self._numbers)
        self.say(json.dumps({"jsonrpc": "2.0", "id": number, "method": method, "params": params}).encode() + b"\n")
        return number

    async def call(self, method: str, **params: Any) -> Any:
        """The result, or the `data` of the error."""
        number = self.ask(method, **params)
        while True:
            message = await self.line()
            if "method" in message:
                self.notices.append(message)
            elif message["id"] == number:
                return message["result"] if "result" in message else message["error"].get("data", message["error"])

    async def close(self) -> None:
        self.writer.close()
        with suppress(OSError):  # the door may have left first
            await self.writer.wait_closed()


@asynccontextmanager
async def dialled(path: Path | str) -> AsyncIterator[Raw]:
    raw = Raw(*await asyncio.open_unix_connection(str(path)))
    try:
        yield raw
    finally:
        await raw.close()


@asynccontextmanager
async def served(
    folder: Path, setup: Config | None = None, *, handshake: float = HANDSHAKE, **door: Any
) -> AsyncIterator[tuple[LocalRig, NativeDoor, Path]]:
    """A rig behind its door; `door`: keys of `door:`."""
    path = folder / "servobus.sock"
    made = replace(setup or config(), door=DoorOptions(**door))
    async with open_rig(made) as rig, open_test_door(rig, path, handshake=handshake) as native:
        yield rig, native, path
