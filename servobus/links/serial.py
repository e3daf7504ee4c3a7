"""A serial port: pyserial opens and configures it, pyserial-asyncio's transport owns its life.

The transport is a subclass that reads and writes the descriptor directly, which costs a third of going through pyserial, and
that never waits: leaving a port whose buffer is stuck throws the rest away instead of draining it.
"""

from __future__ import annotations

import asyncio
import errno
import os
import stat
import termios
from contextlib import suppress
from typing import Any

import serial
import serial.rs485
from serial_asyncio import SerialTransport

from servobus.errors import LinkDown, PortBusy, PortDenied, PortMissing
from servobus.links.ports import find_holder
from servobus.protocols.base import LineTraits

CHUNK = 4096
MOST_UNSENT = 64 * 1024
"""Bytes that may wait for room in the kernel's buffer; a port that takes none for so long is gone."""
USB_LATENCY = 0.002
"""Seconds an adapter may sit on a reply. FTDI's own default is 16 ms, and low latency mode (asked for at open) makes it 1."""
PTY_MAJORS = range(136, 144)
GONE = "was unplugged, or its other end closed: it is opened again when it is back"


class SerialLink:
    """See `links.base.Link`. `rs485`: the kernel switches the transmitter, where the driver can."""

    def __init__(self, port: str, baudrate: int, *, rs485: bool = False) -> None:
        self.address = port
        self._baudrate = baudrate
        self._rs485 = rs485

    @property
    def traits(self) -> LineTraits:
        """A PTY has no wire, so what is heard early on it may be an answer."""
        pty = _is_pty(self.address)
        latency = 0.0 if pty else USB_LATENCY
        return LineTraits(self._baudrate, paced=not pty, latency=latency, can_change_baud=True)

    async def connect(self, protocol: asyncio.Protocol) -> DirectTransport:
        """Raises PortMissing, PortBusy, PortDenied, LinkDown."""
        check_device(self.address)
        try:
            port = self._open()
        except (OSError, ValueError) as error:
            raise explain(self.address, error) from None
        transport = DirectTransport(asyncio.get_running_loop(), protocol, port)
        await transport.made
        return transport

    def _open(self) -> serial.Serial:
        """DTR and RTS stay as the driver sets them at open: adapters that switch their transmitter by RTS have their own driver."""
        # An inter-byte timeout makes pyserial set VMIN to 1: a read that finds nothing says so, and only a hang-up reads as empty.
        port = serial.Serial(
            self.address, self._baudrate, timeout=0, write_timeout=0, inter_byte_timeout=0, exclusive=True
        )
        try:
            if self._rs485:
                port.rs485_mode = serial.rs485.RS485Settings()
        except (OSError, ValueError, NotImplementedError):
            port.close()
            raise LinkDown(f"{self.address}: the driver has no RS485 mode: take out `rs485: true` (USB adapters switch by themselves)") from None
        if not _is_pty(self.address):
            with suppress(OSError, ValueError, NotImplementedError, AttributeError):
                port.set_low_latency_mode(True)
        port.reset_input_buffer()
        return port


class DirectTransport(SerialTransport):  # type: ignore[misc]  # pyserial-asyncio publishes no types
    """See `links.base.Transport`."""

    def __init__(self, loop: asyncio.AbstractEventLoop, protocol: asyncio.Protocol, port: serial.Serial) -> None:
        self.made: asyncio.Future[None] = loop.create_future()
        self._descriptor = port.fileno()
        self._unsent = b""
        super().__init__(loop, protocol, port)
        loop.call_soon(self.made.set_result, None)  # behind connection_made and the reader, which the base has queued

    def write(self, data: bytes) -> None:
        """At once, as far as there is room; the rest when there is."""
        if self._closing:
            return
        if not self._unsent:
            try:
                data = data[os.write(self._descriptor, data) :]
            except (BlockingIOError, InterruptedError):
                pass
            except OSError as error:
                self._lose(error)
                return
        if data:
            self._unsent += data
            if len(self._unsent) > MOST_UNSENT:
                self._lose(OSError(errno.ENOBUFS, "it takes no more bytes"))
            else:
                self._ensure_writer()

    def look(self) -> bool:
        """Read what is there now."""
        if not self._closing:
            self._read_ready()
        return True

    def set_baudrate(self, baudrate: int) -> None:
        """Takes effect at once. The master calls it between two turns, when what it said has been answered, so nothing of ours is
        still leaving that would have to be waited for."""
        self._serial.baudrate = baudrate

    def get_write_buffer_size(self) -> int:
        return len(self._unsent)

    def _read_ready(self) -> None:
        try:
            data = os.read(self._descriptor, CHUNK)
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:
            self._lose(error)
            return
        if data:
            self._protocol.data_received(data)
        else:
            self._lose(OSError(errno.EIO, "end of file"))

    def _write_ready(self) -> None:
        try:
            self._unsent = self._unsent[os.write(self._descriptor, self._unsent) :]
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:
            self._lose(error)
            return
        if not self._unsent:
            self._remove_writer()
            if self._closing:
                self._close()

    def _lose(self, error: OSError) -> None:
        """The port is gone; told once."""
        if not self._closing:
            self._abort(LinkDown(f"{self._serial.name} {GONE} ({error.strerror})"))

    def _call_connection_lost(self, exc: Exception | None) -> None:
        """Not the base's: that drains the port first, which never ends when the other side takes nothing."""
        port, protocol = self._serial, self._protocol
        if port is None:
            return
        self._serial = self._protocol = None
        self._unsent = b""
        with suppress(termios.error, OSError):
            termios.tcflush(self._descriptor, termios.TCIOFLUSH)
        with suppress(OSError):
            port.close()
        protocol.connection_lost(exc)


def check_device(path: str) -> None:
    """Raises PortMissing for what is no serial port, before anything is opened."""
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        raise PortMissing(f"{path} does not exist: plug the adapter in, or see `servobus ports`") from None
    except OSError as error:
        raise explain(path, error) from None
    if not stat.S_ISCHR(mode):
        kind = "a directory" if stat.S_ISDIR(mode) else "no character device"
        raise PortMissing(f"{path} is {kind}: a port is a tty, see `servobus ports`")


def explain(path: str, error: Any) -> LinkDown:
    """What the system's error means and what to do about it."""
    code = getattr(error, "errno", None) or _errno_in(error)
    if code in (errno.EACCES, errno.EPERM):
        return PortDenied(f"this user may not open {path}: `sudo usermod -aG dialout $USER`, then log in again")
    if code in (errno.EBUSY, errno.EWOULDBLOCK):
        holder = find_holder(path)
        who = f"process {holder[0]} ({holder[1]})" if holder else "another process"
        return PortBusy(f"{path} is held by {who}: end that, or use the daemon that holds it")
    if code in (errno.ENOENT, errno.ENXIO, errno.ENODEV):
        return PortMissing(f"{path} has gone: plug the adapter in again")
    if code in (errno.ENOTTY, errno.EINVAL):
        return PortMissing(f"{path} is no serial port: see `servobus ports`")
    return LinkDown(f"{path} cannot be opened ({error}): see `servobus ports`")


def _errno_in(error: Any) -> int | None:
    """pyserial wraps the system's error of a failed lock without its number."""
    cause = error.__context__
    return getattr(cause, "errno", None)


def _is_pty(path: str) -> bool:
    try:
        return os.major(os.stat(path).st_rdev) in PTY_MAJORS
    except OSError:
        return False
