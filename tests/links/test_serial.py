"""Serial links over real PTYs: opening, bytes, and rates."""

from __future__ import annotations

import asyncio
import fcntl
import gc
import termios
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from servobus.errors import LinkDown
from servobus.links.serial import MAX_UNSENT, UART_LATENCY, USB_LATENCY, SerialLink
from servobus.protocols.base import LineTraits
from tests.links.bare_pty import plugged
from tests.links.recorder import Receiver, on_each_loop

ODD_RATES = (76_800, 128_000, 250_000, 256_000, 512_000)


@on_each_loop
async def test_both_ways() -> None:
    receiver = Receiver()
    with plugged() as pty:
        transport = await SerialLink(pty.path, 1_000_000).connect(receiver)
        assert receiver.made == 1
        every = bytes(range(256))  # none means anything to the terminal
        transport.write(every)
        assert await pty.receive(256) == every
        pty.send(every)
        assert await receiver.until(256) == every
        transport.abort()
        assert await receiver.gone() is None


@pytest.mark.parametrize("baudrate", [9_600, 115_200, 1_000_000, *ODD_RATES])
async def test_any_rate(baudrate: int) -> None:
    """At open, and changed to while open, from a rate that is custom as well."""
    with plugged() as pty:
        transport = await SerialLink(pty.path, baudrate).connect(Receiver())
        assert pty.baudrate() == baudrate
        for rate in (333_333, baudrate):
            transport.set_baudrate(rate)
            assert pty.baudrate() == rate
        transport.abort()


async def test_the_rate_changes_when_everything_is_sent() -> None:
    with plugged() as pty:
        transport = await SerialLink(pty.path, 9_600).connect(Receiver())
        transport.write(b"at the old rate")
        transport.set_baudrate(115_200)
        transport.set_baudrate(57_600)  # the last one counts
        transport.write(b"at the ")
        transport.write(b"new rate")
        assert await pty.receive(30) == b"at the old rateat the new rate"
        assert pty.baudrate() == 57_600
        transport.abort()


async def test_until_then_the_rate_is_the_old_one() -> None:
    """Bytes for ten seconds, for which no test waits."""
    receiver = Receiver()
    with plugged() as pty:
        transport = await SerialLink(pty.path, 300).connect(receiver)
        transport.write(bytes(300))
        transport.set_baudrate(115_200)
        transport.write(b"later")
        assert transport.get_write_buffer_size() == 5
        assert await pty.receive(300) == bytes(300)
        assert (pty.baudrate(), pty.received()) == (300, b"")
        transport.abort()
        assert await receiver.gone() is None


async def test_bytes_that_wait_for_a_rate_are_bounded() -> None:
    receiver = Receiver()
    with plugged() as pty:
        transport = await SerialLink(pty.path, 300).connect(receiver)
        transport.write(bytes(300))
        transport.set_baudrate(115_200)
        transport.write(bytes(MAX_UNSENT))
        assert not transport.is_closing()
        transport.write(b"x")
        assert "takes no more bytes" in str(await receiver.gone())


async def test_a_close_during_a_change_of_rate_sends_everything() -> None:
    receiver = Receiver()
    with plugged() as pty:
        transport = await SerialLink(pty.path, 9_600).connect(receiver)
        transport.write(b"old")
        transport.set_baudrate(115_200)
        transport.write(b"new")
        transport.close()
        assert await pty.receive(6) == b"oldnew"
        assert await receiver.gone() is None


async def test_looking_hands_over_what_is_there() -> None:
    """At once, without a pass of the loop; and finding nothing means nothing."""
    receiver = Receiver()
    with plugged() as pty:
        transport = await SerialLink(pty.path, 115_200).connect(receiver)
        assert transport.poll_input()
        pty.send(b"late")
        assert receiver.received == b""
        assert transport.poll_input()
        assert receiver.received == b"late"
        assert transport.poll_input()
        assert (receiver.pieces, receiver.lost) == ([b"late"], [])
        transport.abort()
        pty.send(b"too late")
        assert transport.poll_input()
        assert await receiver.gone() is None
        assert receiver.received == b"late"


async def test_what_came_before_is_thrown_away() -> None:
    receiver = Receiver()
    with plugged() as pty:
        pty.send(b"of yesterday")
        transport = await SerialLink(pty.path, 115_200).connect(receiver)
        pty.send(b"today")
        assert await receiver.until(1) == b"today"
        transport.abort()


async def test_no_rs485_mode() -> None:
    """The message names the option; the port is left free."""
    receiver = Receiver()
    with plugged() as pty:
        with pytest.raises(LinkDown, match=r"no RS485 mode: take out `rs485: true`"):
            await SerialLink(pty.path, 115_200, rs485=True).connect(receiver)
        fcntl.flock(pty.slave, fcntl.LOCK_EX | fcntl.LOCK_NB)
        assert (receiver.made, receiver.lost) == (0, [])


@pytest.mark.parametrize("rs485", [False, True])
async def test_cancelled_while_it_opens(rs485: bool) -> None:
    """What the thread opens afterwards is closed again, and an error of it is ignored."""
    loop = asyncio.get_running_loop()
    problems: list[dict[str, Any]] = []
    loop.set_exception_handler(lambda loop, context: problems.append(context))
    loop.set_default_executor(ThreadPoolExecutor(1))
    receiver = Receiver()
    with plugged() as pty:
        task = asyncio.create_task(SerialLink(pty.path, 115_200, rs485=rs485).connect(receiver))
        await asyncio.sleep(0)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        await loop.run_in_executor(None, int)  # behind the opening, in the only thread
        fcntl.flock(pty.slave, fcntl.LOCK_EX | fcntl.LOCK_NB)
    gc.collect()
    assert (receiver.made, problems) == (0, [])


async def test_cancelled_as_it_opened() -> None:
    class Impatient(Receiver):
        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            super().connection_made(transport)
            task.cancel()

    receiver = Impatient()
    with plugged() as pty:
        task = asyncio.create_task(SerialLink(pty.path, 115_200).connect(receiver))
        with pytest.raises(asyncio.CancelledError):
            await task
        assert await receiver.gone() is None
        fcntl.flock(pty.slave, fcntl.LOCK_EX | fcntl.LOCK_NB)


def test_traits_of_a_pty() -> None:
    """Its bytes take no time, but the simulator behind it may keep wire time."""
    with plugged() as pty:
        assert SerialLink(pty.path, 115_200).traits == LineTraits(115_200, can_change_baud=True)


@pytest.mark.parametrize(
    ("device", "latency"),
    [("ttyUSB0", USB_LATENCY), ("ttyACM12", USB_LATENCY), ("ttyS0", UART_LATENCY), ("ttyAMA0", UART_LATENCY)],
)
def test_traits_of_a_port(tmp_path: Path, device: str, latency: float) -> None:
    """By the device, whatever link leads to it."""
    (tmp_path / device).touch()
    (tmp_path / "arm").symlink_to(device)
    link = SerialLink(str(tmp_path / "arm"), 76_800)
    assert link.address == str(tmp_path / "arm")
    assert link.traits == LineTraits(76_800, paced=True, latency=latency, can_change_baud=True)


async def test_the_line_is_raw() -> None:
    """Nothing is translated, echoed or taken as a signal, and there is no flow control."""
    with plugged() as pty:
        cooked = termios.tcgetattr(pty.slave)
        cooked[0] |= termios.ICRNL | termios.IXON
        cooked[1] |= termios.OPOST | termios.ONLCR
        cooked[3] |= termios.ICANON | termios.ECHO | termios.ISIG
        termios.tcsetattr(pty.slave, termios.TCSANOW, cooked)
        receiver = Receiver()
        transport = await SerialLink(pty.path, 115_200).connect(receiver)
        pty.send(b"\r\n\x03\x11\x13\x04")
        assert await receiver.until(6) == b"\r\n\x03\x11\x13\x04"
        transport.write(b"\r\n")
        assert await pty.receive(2) == b"\r\n"
        assert pty.received() == b""
        transport.abort()


TIOCGEXCL = 0x80045440
"""Whether a terminal is open for one process alone (linux/tty.h); Python has no name for it."""


async def test_a_pty_is_not_marked_for_one_process_alone() -> None:
    """It would remember that after its close, and no other user could open it again. A real port forgets it."""
    with plugged() as pty:
        transport = await SerialLink(pty.path, 1_000_000).connect(Receiver())
        state = fcntl.ioctl(transport.serial.fileno(), TIOCGEXCL, b"\0\0\0\0")
        assert int.from_bytes(state, "little") == 0
        transport.abort()
