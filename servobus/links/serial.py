"""A serial port: pyserial opens and configures it, and pyserial-asyncio's transport owns its life.

`DirectTransport` is a subclass that reads and writes the file descriptor itself, because going through pyserial costs three times
as much. It never waits for the port: one loop serves several buses, and a slow port must not delay the others.
"""

from __future__ import annotations

import asyncio
import errno
import fcntl
import os
import termios
import time
from contextlib import suppress

import serial
import serial.rs485
from serial_asyncio import SerialTransport

from servobus.errors import LinkDown
from servobus.links.tty import check_device, explain_open_error, is_pty
from servobus.protocols.base import LineTraits

CHUNK = 4096
MAX_UNSENT = 64 * 1024
"""Bytes that may wait for space in the kernel's buffer. The port counts as gone when more wait."""
USB_LATENCY = 0.002
"""Seconds an adapter may keep a reply. FTDI's default is 16 ms; low latency mode, which is requested at open, makes it 1 ms."""
UART_LATENCY = 0.001
ADAPTER_MARGIN = 0.002
"""Seconds an adapter needs to send on what the kernel gave it."""
USB_NAMES = ("ttyUSB", "ttyACM")
GONE = "was unplugged, or its other end closed: it is opened again when it is back"


class SerialLink:
    """A device file; see `links.base.Link`."""

    def __init__(self, port: str, baudrate: int, *, rs485: bool = False) -> None:
        """`rs485`: let the kernel switch the transmitter, where the port's driver can."""
        self.address = port
        self._baudrate = baudrate
        self._rs485 = rs485

    @property
    def traits(self) -> LineTraits:
        """The line's traits. Bytes on a PTY take no time on a wire, so a reply may arrive early there; deadlines still use the
        rate."""
        if is_pty(self.address):
            return LineTraits(self._baudrate, can_change_baud=True)
        usb = os.path.basename(os.path.realpath(self.address)).startswith(USB_NAMES)
        return LineTraits(self._baudrate, paced=True, latency=USB_LATENCY if usb else UART_LATENCY, can_change_baud=True)

    async def connect(self, protocol: asyncio.Protocol) -> DirectTransport:
        """Open the port. Raises PortMissing, PortBusy, PortDenied, LinkDown."""
        check_device(self.address)
        loop = asyncio.get_running_loop()
        # A USB adapter that hangs blocks open() for seconds, so a thread does it.
        pending_port = loop.run_in_executor(None, self._open)
        try:
            port = await asyncio.shield(pending_port)
        except asyncio.CancelledError:
            pending_port.add_done_callback(_close_unwanted)
            raise
        transport = DirectTransport(loop, protocol, port)
        try:
            await asyncio.sleep(0)  # the base class has queued connection_made and the reader: let them run first
        except asyncio.CancelledError:
            transport.abort()
            raise
        return transport

    def _open(self) -> serial.Serial:
        """Open and configure the port, for this process alone (flock and TIOCEXCL); discards what arrived before.

        Linux raises DTR and RTS when a port is opened, pyserial raises them again, and servobus does not change them afterwards.
        So there is no edge that could reset a board or switch a transmitter.
        """
        try:
            # With an inter-byte timeout pyserial sets VMIN to 1. Then a read without data raises BlockingIOError, and an empty
            # read means a hang-up.
            port = serial.Serial(self.address, self._baudrate, timeout=0, write_timeout=0, inter_byte_timeout=0, exclusive=True)
        except (OSError, ValueError, termios.error) as error:
            raise explain_open_error(self.address, error) from None
        try:
            if self._rs485:
                port.rs485_mode = serial.rs485.RS485Settings()
        except (OSError, ValueError):
            port.close()
            advice = "take out `rs485: true` (USB adapters switch by themselves)"
            raise LinkDown(f"{self.address}: its driver has no RS485 mode: {advice}") from None
        if not is_pty(self.address):  # a PTY would remember TIOCEXCL after its close
            with suppress(OSError, ValueError):
                port.set_low_latency_mode(True)
            with suppress(OSError):  # flock keeps out programs that ask for it, this the others, but for root
                fcntl.ioctl(port.fileno(), termios.TIOCEXCL)
        return port


class DirectTransport(SerialTransport):  # type: ignore[misc]  # pyserial-asyncio publishes no types
    """An open port; see `links.base.Transport`."""

    _has_writer: bool

    def __init__(self, loop: asyncio.AbstractEventLoop, protocol: asyncio.Protocol, port: serial.Serial) -> None:
        self._port = port
        self._descriptor = port.fileno()
        self._unsent = b""
        self._deferred: bytes | None = None
        """Bytes to send after a change of rate; None while no change is pending."""
        self._rate: int = port.baudrate
        self._busy_until = 0.0
        """Monotonic time at which the line will have sent everything that was written."""
        self._aborted = self._ended = False
        super().__init__(loop, protocol, port)

    def write(self, data: bytes) -> None:
        """Write as much as the kernel takes now; the rest follows when there is space."""
        if self._closing:
            return
        if self._deferred is None:
            self._send(data)
        else:
            self._deferred += data
        if (self._unsent or self._deferred) and self.get_write_buffer_size() > MAX_UNSENT:
            self._lose(OSError(errno.ENOBUFS, "it takes no more bytes"))

    def poll_input(self) -> bool:
        """Read what has arrived."""
        if not self._closing:
            self._read_ready()
        return True

    def set_baudrate(self, baudrate: int) -> None:
        """Change the rate when everything written so far is sent; later writes follow at the new rate.

        `tcdrain` would wait for that too, but it would block the loop, and it does not see what an adapter still keeps.
        """
        self._rate = baudrate
        if self._deferred is None:
            self._deferred = b""
            self._change_rate()

    def get_write_buffer_size(self) -> int:
        """Return the bytes that the kernel has not taken yet."""
        return len(self._unsent) + len(self._deferred or b"")

    def _send(self, data: bytes) -> None:
        now = time.monotonic()
        if self._busy_until < now:
            self._busy_until = now
        self._busy_until += len(data) * 10 / self._rate
        if not self._unsent:
            try:
                written = os.write(self._descriptor, data)
                if written == len(data):
                    return
                data = data[written:]
            except (BlockingIOError, InterruptedError):
                pass
            except OSError as error:
                self._lose(error)
                return
        if data:
            self._unsent += data
            if not self._has_writer:
                self._loop.add_writer(self._descriptor, self._write_ready)
                self._has_writer = True

    def _change_rate(self) -> None:
        """Change the rate, or try again when the line is silent."""
        if self._ended:
            return
        wait = self._busy_until + ADAPTER_MARGIN - time.monotonic()
        if wait > 0 or self._unsent:
            self._loop.call_later(max(wait, ADAPTER_MARGIN), self._change_rate)
            return
        try:
            self._port.baudrate = self._rate
        except (OSError, ValueError, termios.error) as error:
            self._lose(error)
            return
        deferred, self._deferred = self._deferred, None
        if deferred:
            self._send(deferred)
        if self._closing:
            self._close()

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

    def _lose(self, error: Exception) -> None:
        """End the connection because the port is gone; without an error if it was closing anyway."""
        reason = getattr(error, "strerror", None) or error
        self._abort(None if self._closing else LinkDown(f"{self._port.name} {GONE} ({reason})"))

    def _close(self, exc: Exception | None = None) -> None:
        """Close once the line has sent everything: closing a port earlier blocks the loop until it has."""
        self._closing = True
        self._remove_reader()
        if not self._unsent and self._deferred is None:
            self._remove_writer()
            self._loop.call_later(max(0.0, self._busy_until - time.monotonic()), self._call_connection_lost, exc)

    def _abort(self, exc: Exception | None) -> None:
        self._aborted = True
        super()._abort(exc)

    def _call_connection_lost(self, exc: Exception | None) -> None:
        """Report the end once. Replaces the base class's method, which drains the port and blocks when the other side reads
        nothing."""
        if self._ended:
            return
        self._ended = True
        with suppress(termios.error, OSError):
            if self._aborted or self._port.out_waiting:
                self._port.reset_output_buffer()
        with suppress(OSError):
            self._port.close()
        self._protocol.connection_lost(exc)


def _close_unwanted(port: asyncio.Future[serial.Serial]) -> None:
    """Close a port that was opened after its caller had given up."""
    if not port.cancelled() and port.exception() is None:
        port.result().close()
