"""A simulated line as a serial port that any program can open: a PTY.

A PTY has no baud rate of its own, but it keeps the one its user set; the line is told that rate before each chunk. This process
keeps the slave side open, so users may come and go. Closing the PTY looks to them like a pulled plug.
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
"""struct termios2, which also has custom rates; termios does not. Its last field is the output speed."""
CHUNK = 4096
FULL, HALF = 0.1, 0.05
"""Seconds of unsent bytes at which it stops reading, and at which it reads again. Unread bytes fill the system's buffer, and then
the user's writes wait, as with a UART."""


class SimulatedPty:
    """A PTY in front of a line, open from the start. `path` is what a user opens: the symlink, if one was asked for."""

    def __init__(
        self,
        far: FarEnd,
        loop: asyncio.AbstractEventLoop,
        *,
        backlog: Callable[[], float] = float,
        symlink: Path | None = None,
    ) -> None:
        """Open a PTY. `backlog`: returns the seconds that the line needs to send what it was given."""
        self.dropped = 0
        """Bytes that were lost because no user read them and the buffer was full."""
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
        """Pull the plug: a user gets an error. Removes the symlink, unless it leads elsewhere by now."""
        if self._master < 0:
            return
        self._loop.remove_reader(self._master)
        if self._symlink and self._symlink.is_symlink() and os.readlink(self._symlink) == self._device:
            self._symlink.unlink()
        self._close_descriptors()

    def baudrate(self) -> int:
        """Return the rate that its user set last."""
        speed: int = TERMIOS2.unpack(fcntl.ioctl(self._slave, TCGETS2, bytes(TERMIOS2.size)))[-1]
        return speed

    def _read(self) -> None:
        data = os.read(self._master, CHUNK)
        # A user's TIOCEXCL outlives the user, because the slave stays open here. Without this, only root could open it again.
        fcntl.ioctl(self._slave, termios.TIOCNXCL)
        if speed := self.baudrate():  # 0 means hang up
            self._far.set_baudrate(speed)
        self._far.receive(data)
        if (backlog := self._backlog()) > FULL:
            self._loop.remove_reader(self._master)
            self._loop.call_later(backlog - HALF, self._resume)

    def _resume(self) -> None:
        if self._master >= 0:
            self._loop.add_reader(self._master, self._read)

    def _write(self, data: bytes) -> None:
        """Write what there is space for; the rest is lost and counted, as with a UART."""
        if self._master < 0:
            return
        try:
            written = os.write(self._master, data)
        except BlockingIOError:
            written = 0
        self.dropped += len(data) - written

    def _publish(self) -> None:
        """Make the symlink atomically. Replaces another symlink, but never a file."""
        if self._symlink is None:
            return
        if self._symlink.exists() and not self._symlink.is_symlink():
            raise FileExistsError(f"{self._symlink} is not a symlink, so it is not replaced: choose another path")
        temporary = self._symlink.with_name(f".{self._symlink.name}.{os.getpid()}")
        temporary.symlink_to(self._device)
        temporary.replace(self._symlink)

    def _close_descriptors(self) -> None:
        os.close(self._slave)
        os.close(self._master)
        self._master = -1
