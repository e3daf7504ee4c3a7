"""A line within the process: what is said and heard, one user at a time, and the plug."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import pytest

from servobus.errors import LinkDown, PortBusy, PortMissing
from servobus.links.memory import MemoryLink
from servobus.protocols.base import LineTraits
from tests.links.recorder import Ear
from tests.virtual_time import virtual

TRAITS = LineTraits(9_600, can_change_baud=True)


class Far:
    """A far end that keeps what it is told and says what the test says."""

    def __init__(self) -> None:
        self.heard: list[bytes | int] = []
        self.say: Callable[[bytes], None] = self.heard.append

    def attach(self, deliver: Callable[[bytes], None]) -> None:
        self.say = deliver

    def receive(self, data: bytes) -> None:
        self.heard.append(data)

    def set_baudrate(self, baudrate: int) -> None:
        self.heard.append(baudrate)


@virtual
async def test_both_ways() -> None:
    far, ear = Far(), Ear()
    link = MemoryLink(far, TRAITS)
    transport = await link.connect(ear)
    transport.write(b"question")
    transport.set_baudrate(115_200)
    far.say(b"answer")
    assert (link.traits, link.address) == (TRAITS, "sim:")
    assert far.heard == [b"question", 115_200]
    assert (ear.made, ear.pieces) == (1, [b"answer"])
    assert not transport.poll_input()


@virtual
async def test_nobody_hears_a_line_that_is_not_open() -> None:
    far, ear = Far(), Ear()
    link = MemoryLink(far, TRAITS)
    far.say(b"before")
    transport = await link.connect(ear)
    transport.close()
    far.say(b"after")
    transport.write(b"after")
    assert await ear.gone() is None
    assert (ear.pieces, far.heard) == ([], [])


@virtual
async def test_lost_is_said_once_and_never_from_within_a_call() -> None:
    ear = Ear()
    link = MemoryLink(Far(), TRAITS)
    transport = await link.connect(ear)
    transport.close()
    transport.abort()
    link.unplug()
    assert transport.is_closing()
    assert ear.lost == []
    assert await ear.gone() is None


@virtual
async def test_one_user_at_a_time() -> None:
    link = MemoryLink(Far(), TRAITS, "sim:arm")
    first, second = Ear(), Ear()
    transport = await link.connect(first)
    with pytest.raises(PortBusy, match=r"sim:arm is open already.*close it first"):
        await link.connect(second)
    transport.close()
    await link.connect(second)
    assert (first.lost, second.made, second.lost) == ([None], 1, [])


@virtual
async def test_of_two_at_the_same_time_one_is_busy() -> None:
    link = MemoryLink(Far(), TRAITS)
    results = await asyncio.gather(link.connect(Ear()), link.connect(Ear()), return_exceptions=True)
    assert [type(result).__name__ for result in results] == ["MemoryTransport", "PortBusy"]


@virtual
async def test_who_reconnects_hears_of_the_loss_first() -> None:
    """One protocol for both connections, as a bus does it: the end of the old one must not look like the end of the new one."""

    class Diary(Ear):
        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            entries.append("made")

        def connection_lost(self, exc: Exception | None) -> None:
            entries.append("lost")

    entries: list[str] = []
    link, diary = MemoryLink(Far(), TRAITS), Diary()
    (await link.connect(diary)).abort()
    await link.connect(diary)
    assert entries == ["made", "lost", "made"]


@virtual
async def test_the_plug() -> None:
    far, ear, again = Far(), Ear(), Ear()
    link = MemoryLink(far, TRAITS)
    transport = await link.connect(ear)
    link.unplug()
    transport.write(b"into the void")
    error = await ear.gone()
    assert isinstance(error, LinkDown)
    assert "plug it in again" in str(error)
    with pytest.raises(PortMissing, match="plug it in"):
        await link.connect(again)
    link.plug()
    (await link.connect(again)).write(b"back")
    far.say(b"hello")
    assert (far.heard, again.heard, ear.heard) == ([b"back"], b"hello", b"")


@virtual
async def test_a_plug_that_nobody_uses() -> None:
    link = MemoryLink(Far(), TRAITS)
    link.unplug()
    link.plug()
    ear = Ear()
    await link.connect(ear)
    assert (ear.made, ear.lost) == (1, [])
