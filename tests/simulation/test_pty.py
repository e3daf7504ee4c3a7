"""The PTY in front of a simulated line: rates, users that come and go, and the plug."""

from __future__ import annotations

import asyncio
import errno
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
import serial

from servobus.simulation.pty import FULL, HALF, SimulatedPty


class EchoEnd:
    """A far end that records what it receives."""

    def __init__(self) -> None:
        self.sent: list[bytes | int] = []
        self.deliver: Callable[[bytes], None] = self.sent.append
        self._news = asyncio.Event()

    def attach(self, deliver: Callable[[bytes], None]) -> None:
        self.deliver = deliver

    def set_baudrate(self, baudrate: int) -> None:
        self.sent.append(baudrate)

    def receive(self, data: bytes) -> None:
        self.sent.append(data)
        self._news.set()

    async def news(self) -> list[bytes | int]:
        """Return what it received since the last call."""
        async with asyncio.timeout(10):
            await self._news.wait()
        self._news.clear()
        sent, self.sent = self.sent, []
        return sent


@pytest.mark.parametrize("baudrate", [9_600, 115_200, 1_000_000, 76_800, 128_000, 250_000, 512_000])
async def test_the_far_end_hears_the_rate_before_the_bytes(baudrate: int) -> None:
    """Standard and custom rates, as pyserial sets them."""
    far = EchoEnd()
    pty = SimulatedPty(far, asyncio.get_running_loop())
    with serial.Serial(pty.path, baudrate, timeout=10) as port:
        port.write(b"\xff\x00\x0d\x0a\x03\x11")
        assert await far.news() == [baudrate, b"\xff\x00\x0d\x0a\x03\x11"]
        far.deliver(b"\x04\x0a\xff\x00\x13")
        assert port.read(5) == b"\x04\x0a\xff\x00\x13"
    pty.close()


async def test_users_come_and_go() -> None:
    """The port stays when its user leaves, and the next user may have another rate."""
    far = EchoEnd()
    pty = SimulatedPty(far, asyncio.get_running_loop())
    for baudrate in (57_600, 1_000_000):
        with serial.Serial(pty.path, baudrate) as port:
            port.write(b"here")
            assert await far.news() == [baudrate, b"here"]
    pty.close()


async def test_rate_0_is_no_rate() -> None:
    """A hang-up (B0) is not a choice of a rate."""
    far = EchoEnd()
    pty = SimulatedPty(far, asyncio.get_running_loop())
    with serial.Serial(pty.path, 0) as port:
        port.write(b"x")
        assert await far.news() == [b"x"]
    pty.close()


async def test_what_nobody_reads_is_dropped_and_counted() -> None:
    """The line does not wait and its buffer does not grow; afterwards it works again."""
    far = EchoEnd()
    pty = SimulatedPty(far, asyncio.get_running_loop())
    with serial.Serial(pty.path, 115_200, timeout=10) as port:
        for _ in range(1000):
            far.deliver(bytes(1000))
        assert 0 < pty.dropped < 1_000_000
        received = b""
        while not received.endswith(b"again"):
            far.deliver(b"again")
            received = received[-4:] + port.read(port.in_waiting or 1)
    pty.close()


async def test_a_user_who_says_too_much_waits() -> None:
    """As with a UART: behind a slow line the buffers fill, and what is in them is not lost but late."""
    far, unsaid = EchoEnd(), [FULL, FULL + 0.01]
    pty = SimulatedPty(far, asyncio.get_running_loop(), backlog=lambda: unsaid.pop(0))
    with serial.Serial(pty.path, 115_200) as port:
        for word in (b"first", b"second"):
            port.write(word)
            assert await far.news() == [115_200, word]
        os.set_blocking(port.fileno(), False)
        sent = 0
        with suppress(BlockingIOError):
            while sent < 1_000_000:
                sent += os.write(port.fileno(), bytes(1000))
        assert sent < 1_000_000
        unsaid += [0.0] * sent
        received = 0
        while received < sent:
            received += sum(len(part) for part in await far.news() if isinstance(part, bytes))
        assert received == sent
    pty.close()


async def test_the_plug_can_be_pulled_while_a_user_waits() -> None:
    """Nothing is read after that."""
    far = EchoEnd()
    pty = SimulatedPty(far, asyncio.get_running_loop(), backlog=lambda: HALF + FULL)
    with serial.Serial(pty.path, 115_200) as port:
        port.write(b"x")
        await far.news()
        pty.close()
        await asyncio.sleep(FULL + HALF)
        assert far.sent == []


async def test_closing_pulls_the_plug() -> None:
    """The user gets an error, the path is gone, and later bytes are dropped."""
    far = EchoEnd()
    pty = SimulatedPty(far, asyncio.get_running_loop())
    user = os.open(pty.path, os.O_RDWR | os.O_NOCTTY)
    pty.close()
    with pytest.raises(OSError, match="Input/output") as caught:
        os.write(user, b"x")
    assert caught.value.errno == errno.EIO
    os.close(user)
    far.deliver(b"x")
    pty.close()
    with pytest.raises(FileNotFoundError):
        os.stat(pty.path)


async def test_a_stable_name_follows_the_plug(tmp_path: Path) -> None:
    """One name, new device behind it: also when the old one is closed after the new one came."""
    name = tmp_path / "ttyServo"
    loop = asyncio.get_running_loop()
    first = SimulatedPty(EchoEnd(), loop, symlink=name)
    assert first.path == str(name)
    far = EchoEnd()
    second = SimulatedPty(far, loop, symlink=name)
    first.close()
    with serial.Serial(str(name), 115_200) as port:
        port.write(b"new")
        assert await far.news() == [115_200, b"new"]
    second.close()
    assert not name.is_symlink()


async def test_a_file_is_never_replaced(tmp_path: Path) -> None:
    """Only a link gives way."""
    name = tmp_path / "precious"
    name.write_text("data")
    with pytest.raises(FileExistsError, match="choose another"):
        SimulatedPty(EchoEnd(), asyncio.get_running_loop(), symlink=name)
    assert name.read_text() == "data"
