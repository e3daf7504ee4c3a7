"""A serial port: pyserial opens and configures it, pyserial-asyncio's transport owns its life.

The transport is a subclass that reads and writes the descriptor directly, which costs a third of going through pyserial, and that
never waits for a port: a loop serves several buses, and none may stop for another.
"""

from __future__ import annotations

import asyncio
import errno
import os
import termios
import time
from contextlib import suppress

import serial
import serial.rs485
from serial_asyncio import SerialTransport

from servobus.errors import LinkDown
from servobus.links.tty import check_device, explain, is_pty
from servobus.protocols.base import LineTraits

CHUNK = 4096
MAX_UNSENT = 64 * 1024
"""Bytes that may wait for room in the kernel's buffer; a port that takes none for so long is gone."""
USB_LATENCY = 0.002
"""Seconds an adapter may sit on a reply. FTDI's own default is 16 ms, and low latency mode (asked for at open) makes it 1."""
UART_LATENCY = 0.001
ADAPTER_MARGIN = 0.002
"""Seconds after which an adapter has passed on what the kernel gave it."""
USB_NAMES = ("ttyUSB", "ttyACM")
GONE = "was unplugged, or its other end closed: it is opened again when it is back"


class SerialLink:
    """See `links.base.Link`. `rs485`: the kernel switches the transmitter, where the driver can."""

    def __init__(self, port: str, baudrate: int, *, rs485: bool = False) -> None:
        self.address = port
        self._baudrate = baudrate
        self._rs485 = rs485

    @property
    def traits(self) -> LineTraits:
        """A PTY has no wire, so what is heard early on it may be an answer; its rate still tells how long one may take."""
        if is_pty(self.address):
            return LineTraits(self._baudrate, can_change_baud=True)
        usb = os.path.basename(os.path.realpath(self.address)).startswith(USB_NAMES)
        return LineTraits(self._baudrate, paced=True, latency=USB_LATENCY if usb else UART_LATENCY, can_change_baud=True)

    async def connect(self, protocol: asyncio.Protocol) -> DirectTransport:
        """Raises PortMissing, PortBusy, PortDenied, LinkDown."""
        check_device(self.address)
        loop = asyncio.get_running_loop()
        # A USB adapter that hangs keeps whoever opens it for seconds, so a thread waits for it.
        opening = loop.run_in_executor(None, self._open)
        try:
            port = await asyncio.shield(opening)
        except asyncio.CancelledError:
            opening.add_done_callback(_close_again)
            raise
        transport = DirectTransport(loop, protocol, port)
        try:
            await asyncio.sleep(0)  # behind connection_made and the reader, which the base has queued
        except asyncio.CancelledError:
            transport.abort()
            raise
        return transport

    def _open(self) -> serial.Serial:
        """Linux raises DTR and RTS whenever a port is opened, pyserial says the same once more, and nothing here touches them
        afterwards: there is no edge that could reset a board or switch a transmitter. What came before is thrown away."""
        try:
            # An inter-byte timeout makes pyserial set VMIN to 1: then a read that finds nothing says so, and only a hang-up reads
            # as empty.
            port = serial.Serial(self.address, self._baudrate, timeout=0, write_timeout=0, inter_byte_timeout=0, exclusive=True)
        except (OSError, ValueError, termios.error) as error:
            raise explain(self.address, error) from None
        try:
            if self._rs485:
                port.rs485_mode = serial.rs485.RS485Settings()
        except (OSError, ValueError):
            port.close()
            advice = "take out `rs485: true` (USB adapters switch by themselves)"
            raise LinkDown(f"{self.address}: its driver has no RS485 mode: {advice}") from None
        if not is_pty(self.address):
            with suppress(OSError, ValueError):
                port.set_low_latency_mode(True)
        return port


class DirectTransport(SerialTransport):  # type: ignore[misc]  # pyserial-asyncio publishes no types
    """See `links.base.Transport`."""

    _has_writer: bool

    def __init__(self, loop: asyncio.AbstractEventLoop, protocol: asyncio.Protocol, port: serial.Serial) -> None:
        self._port = port
        self._descriptor = port.fileno()
        self._unsent = b""
        self._held: bytes | None = None
        """Written since another baud rate was asked for, while the line still speaks at the old one."""
        self._rate: int = port.baudrate
        self._said_by = 0.0
        """When the line will have said all that was written."""
        self._aborted = self._told = False
        super().__init__(loop, protocol, port)

    def write(self, data: bytes) -> None:
        """At once, as far as there is room; the rest when there is."""
        if self._closing:
            return
        if self._held is None:
            self._say(data)
        else:
            self._held += data
        if self.get_write_buffer_size() > MAX_UNSENT:
            self._lose(OSError(errno.ENOBUFS, "it takes no more bytes"))

    def poll_input(self) -> bool:
        """Read what is there now."""
        if not self._closing:
            self._read_ready()
        return True

    def set_baudrate(self, baudrate: int) -> None:
        """As soon as the line has said what was written; what is written from now on follows at the new rate. `tcdrain` would
        wait for that too, but it would stop the whole loop, and it does not know what an adapter still holds."""
        self._rate = baudrate
        if self._held is None:
            self._held = b""
            self._change_rate()

    def get_write_buffer_size(self) -> int:
        """Bytes that the kernel was not given yet."""
        return len(self._unsent) + len(self._held or b"")

    def _say(self, data: bytes) -> None:
        now = time.monotonic()
        if self._said_by < now:
            self._said_by = now
        self._said_by += len(data) * 10 / self._rate
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
            if not self._has_writer:
                self._loop.add_writer(self._descriptor, self._write_ready)
                self._has_writer = True

    def _change_rate(self) -> None:
        """Or come back when the line has fallen silent."""
        if self._told:
            return
        wait = self._said_by + ADAPTER_MARGIN - time.monotonic()
        if wait > 0 or self._unsent:
            self._loop.call_later(max(wait, ADAPTER_MARGIN), self._change_rate)
            return
        try:
            self._port.baudrate = self._rate
        except (OSError, ValueError, termios.error) as error:
            self._lose(error)
            return
        held, self._held = self._held, None
        if held:
            self._say(held)
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
        """The port is gone. Whoever was leaving anyway has left."""
        reason = getattr(error, "strerror", None) or error
        self._abort(None if self._closing else LinkDown(f"{self._port.name} {GONE} ({reason})"))

    def _close(self, exc: Exception | None = None) -> None:
        """When the line has said everything: a port that is closed before keeps the loop waiting for it."""
        self._closing = True
        self._remove_reader()
        if not self._unsent and self._held is None:
            self._remove_writer()
            self._loop.call_later(max(0.0, self._said_by - time.monotonic()), self._call_connection_lost, exc)

    def _abort(self, exc: Exception | None) -> None:
        self._aborted = True
        super()._abort(exc)

    def _call_connection_lost(self, exc: Exception | None) -> None:
        """Once. Not the base's: that drains the port, which never ends when the other side takes nothing."""
        if self._told:
            return
        self._told = True
        with suppress(termios.error, OSError):
            if self._aborted or self._port.out_waiting:
                self._port.reset_output_buffer()
        with suppress(OSError):
            self._port.close()
        self._protocol.connection_lost(exc)


def _close_again(opening: asyncio.Future[serial.Serial]) -> None:
    """Nobody waits for this port any more."""
    if not opening.cancelled() and opening.exception() is None:
        opening.result().close()
