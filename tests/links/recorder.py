"""A protocol that records what a link delivers, and the event loops on which link tests run."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any

import pytest
import uvloop

LOOPS: dict[str, Callable[[], asyncio.AbstractEventLoop]] = {"asyncio": asyncio.new_event_loop, "uvloop": uvloop.new_event_loop}
PATIENCE = 20
"""Seconds until a test gives up; none takes nearly as long."""


def on_each_loop(test: Callable[[], Coroutine[Any, Any, None]]) -> Callable[[str], None]:
    """A test that runs on asyncio's own loop and on uvloop's."""

    @pytest.mark.parametrize("loop", LOOPS)
    def run(loop: str) -> None:
        with asyncio.Runner(loop_factory=LOOPS[loop]) as runner:
            runner.run(test())

    run.__doc__ = test.__doc__
    return run


class Receiver(asyncio.Protocol):
    """Records what a link reports, in order."""

    def __init__(self) -> None:
        self.pieces: list[bytes] = []
        self.made = 0
        self.lost: list[Exception | None] = []
        self._news = asyncio.Event()

    @property
    def received(self) -> bytes:
        return b"".join(self.pieces)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.made += 1

    def data_received(self, data: bytes) -> None:
        assert not self.lost
        self.pieces.append(data)
        self._news.set()

    def connection_lost(self, exc: Exception | None) -> None:
        self.lost.append(exc)
        self._news.set()

    async def until(self, size: int) -> bytes:
        """Return what was received, once it has this many bytes."""
        await self._until(lambda: len(self.received) >= size)
        return self.received

    async def gone(self) -> Exception | None:
        """Return the reason of connection_lost, which must be called once."""
        await self._until(lambda: bool(self.lost))
        for _ in range(5):
            await asyncio.sleep(0)
        assert len(self.lost) == 1
        return self.lost[0]

    async def _until(self, true: Callable[[], bool]) -> None:
        async with asyncio.timeout(PATIENCE):
            while not true():
                self._news.clear()
                await self._news.wait()
