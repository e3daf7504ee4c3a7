"""A simulated line as a serial port that any program can open: a PTY.

A PTY has no baud rate of its own, but it keeps the one its user set; the far end is told before it hears anything. The slave is
held open, so users may come and go; closing the whole is what pulling the plug looks like to them.
"""

from __future__ import annotations

import asyncio
import fcntl
import os
import struct
import termios
import tty
from collections.abc import Callable
from pathlib import Path

from servobus.links.base import FarEnd

TCGETS2 = 0x802C542A
TERMIOS2 = struct.Struct("4I B 19B 2I")
"""struct termios2: it tells custom rates too, which termios cannot. The last field is the output speed."""
CHUNK = 4096
FULL, HALF = 0.1, 0.05
"""Seconds of unsaid bytes at which it stops reading, and goes on. What it does not read fills the system's buffer, and then its
user waits, as with a UART."""


class SimulatedPty:
    """Open from the start. `path` is what a user opens: the link if one was asked for."""

    def __init__(
        self,
        far: FarEnd,
        loop: asyncio.AbstractEventLoop,
        *,
        backlog: Callable[[], float] = float,
        symlink: Path | None = None,
    ) -> None:
        """`backlog` tells how many seconds the line needs to say what it was given."""
        self.dropped = 0
        """Bytes that nobody read, so that there was no room for them."""
        self._far = far
        self._loop = loop
        self._backlog = backlog
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._device = os.ttyname(self._slave)
        self._symlink = symlink
        try:
            self._publish()
        except OSError:
            self._close_descriptors()
            raise
        far.attach(self._write)
        loop.add_reader(self._master, self._read)

    @property
    def path(self) -> str:
        return str(self._symlink or self._device)

    def close(self) -> None:
        """Pull the plug: whoever has it open gets an error. The link goes too, unless it leads elsewhere by now."""
        if self._master < 0:
            return
        self._loop.remove_reader(self._master)
        if self._symlink and self._symlink.is_symlink() and os.readlink(self._symlink) == self._device:
            self._symlink.unlink()
        self._close_descriptors()

    def baudrate(self) -> int:
        """As the user set it last."""
        speed: int = TERMIOS2.unpack(fcntl.ioctl(self._slave, TCGETS2, bytes(TERMIOS2.size)))[-1]
        return speed

    def _read(self) -> None:
        data = os.read(self._master, CHUNK)
        # A user's claim outlives the user, as the slave stays open: without this nobody else but root could open it.
        fcntl.ioctl(self._slave, termios.TIOCNXCL)
        if speed := self.baudrate():  # 0 hangs up
            self._far.set_baudrate(speed)
        self._far.receive(data)
        if (unsaid := self._backlog()) > FULL:
            self._loop.remove_reader(self._master)
            self._loop.call_later(unsaid - HALF, self._go_on)

    def _go_on(self) -> None:
        if self._master >= 0:
            self._loop.add_reader(self._master, self._read)

    def _write(self, data: bytes) -> None:
        """A UART waits for nobody: what finds no room is lost, and counted."""
        if self._master < 0:
            return
        try:
            written = os.write(self._master, data)
        except BlockingIOError:
            written = 0
        self.dropped += len(data) - written

    def _publish(self) -> None:
        """Let the link lead here at once; only another link is replaced, never a file."""
        if self._symlink is None:
            return
        if self._symlink.exists() and not self._symlink.is_symlink():
            raise FileExistsError(f"{self._symlink} is no link, so it is left alone: choose another path")
        beside = self._symlink.with_name(f".{self._symlink.name}.{os.getpid()}")
        beside.symlink_to(self._device)
        beside.replace(self._symlink)

    def _close_descriptors(self) -> None:
        os.close(self._slave)
        os.close(self._master)
        self._master = -1
