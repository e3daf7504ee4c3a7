"""A bare PTY whose far side is driven by the test."""

from __future__ import annotations

import asyncio
import fcntl
import os
import select
import tty
from collections.abc import Iterator
from contextlib import contextmanager

from servobus.simulation.pty import TCGETS2, TERMIOS2
from tests.links.recorder import PATIENCE


class Pty:
    """`path` is what a link opens. The slave is held open, so that its settings can be read back."""

    def __init__(self) -> None:
        self._master, self.slave = os.openpty()
        tty.setraw(self.slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self.slave)

    def send(self, data: bytes) -> None:
        """When this returns the bytes can be read at the other side."""
        assert os.write(self._master, data) == len(data)
        assert select.select([self.slave], [], [], PATIENCE)[0]

    async def receive(self, size: int) -> bytes:
        """Return this many bytes."""
        received = b""
        while len(received) < size:
            await self._readable()
            received += os.read(self._master, size - len(received))
        return received

    def received(self) -> bytes:
        """Return what has arrived and was not read yet."""
        try:
            return os.read(self._master, 100_000)
        except BlockingIOError:
            return b""

    def baudrate(self) -> int:
        rate: int = TERMIOS2.unpack(fcntl.ioctl(self.slave, TCGETS2, bytes(TERMIOS2.size)))[-1]
        return rate

    def unplug(self) -> None:
        if self._master >= 0:
            os.close(self._master)
            self._master = -1

    def close(self) -> None:
        self.unplug()
        os.close(self.slave)

    async def _readable(self) -> None:
        loop = asyncio.get_running_loop()
        ready = asyncio.Event()
        loop.add_reader(self._master, ready.set)
        try:
            async with asyncio.timeout(PATIENCE):
                await ready.wait()
        finally:
            loop.remove_reader(self._master)


@contextmanager
def plugged() -> Iterator[Pty]:
    pty = Pty()
    try:
        yield pty
    finally:
        pty.close()
