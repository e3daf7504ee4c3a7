"""A line inside the process: bytes in both directions, one user at a time, and the plug."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import pytest

from servobus.errors import LinkDown, PortBusy, PortMissing
from servobus.links.memory import MemoryLink
from servobus.protocols.base import LineTraits
from tests.links.recorder import Receiver
from tests.virtual_time import virtual

TRAITS = LineTraits(9_600, can_change_baud=True)


class Far:
    """A far end that records what it receives and sends what the test tells it to."""

    def __init__(self) -> None:
        self.received: list[bytes | int] = []
        self.send: Callable[[bytes], None] = self.received.append

    def attach(self, deliver: Callable[[bytes], None]) -> None:
        self.send = deliver

    def receive(self, data: bytes) -> None:
        self.received.append(data)

    def set_baudrate(self, baudrate: int) -> None:
        self.received.append(baudrate)


@virtual
async def test_both_ways() -> None:
    far, receiver = Far(), Receiver()
    link = MemoryLink(far, TRAITS)
    transport = await link.connect(receiver)
    transport.write(b"question")
    transport.set_baudrate(115_200)
    far.send(b"answer")
    assert (link.traits, link.address) == (TRAITS, "sim:")
    assert far.received == [b"question", 115_200]
    assert (receiver.made, receiver.pieces) == (1, [b"answer"])
    assert not transport.poll_input()


@virtual
async def test_nobody_hears_a_line_that_is_not_open() -> None:
    far, receiver = Far(), Receiver()
    link = MemoryLink(far, TRAITS)
    far.send(b"before")
    transport = await link.connect(receiver)
    transport.close()
    far.send(b"after")
    transport.write(b"after")
    assert await receiver.gone() is None
    assert (receiver.pieces, far.received) == ([], [])


@virtual
async def test_the_end_is_reported_once_and_not_from_within_a_call() -> None:
    receiver = Receiver()
    link = MemoryLink(Far(), TRAITS)
    transport = await link.connect(receiver)
    transport.close()
    transport.abort()
    link.unplug()
    assert transport.is_closing()
    assert receiver.lost == []
    assert await receiver.gone() is None


@virtual
async def test_one_user_at_a_time() -> None:
    link = MemoryLink(Far(), TRAITS, "sim:arm")
    first, second = Receiver(), Receiver()
    transport = await link.connect(first)
    with pytest.raises(PortBusy, match=r"sim:arm is open already.*close it first"):
        await link.connect(second)
    transport.close()
    await link.connect(second)
    assert (first.lost, second.made, second.lost) == ([None], 1, [])


@virtual
async def test_of_two_at_the_same_time_one_is_busy() -> None:
    link = MemoryLink(Far(), TRAITS)
    results = await asyncio.gather(link.connect(Receiver()), link.connect(Receiver()), return_exceptions=True)
    assert [type(result).__name__ for result in results] == ["MemoryTransport", "PortBusy"]


@virtual
async def test_who_reconnects_hears_of_the_loss_first() -> None:
    """One protocol for both connections, as a bus does it: the end of the old one must not be taken for that of the new one."""

    class Diary(Receiver):
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
    far, receiver, again = Far(), Receiver(), Receiver()
    link = MemoryLink(far, TRAITS)
    transport = await link.connect(receiver)
    link.unplug()
    transport.write(b"into the void")
    error = await receiver.gone()
    assert isinstance(error, LinkDown)
    assert "plug it in again" in str(error)
    with pytest.raises(PortMissing, match="plug it in"):
        await link.connect(again)
    link.plug()
    (await link.connect(again)).write(b"back")
    far.send(b"hello")
    assert (far.received, again.received, receiver.received) == ([b"back"], b"hello", b"")


@virtual
async def test_a_plug_that_nobody_uses() -> None:
    link = MemoryLink(Far(), TRAITS)
    link.unplug()
    link.plug()
    receiver = Receiver()
    await link.connect(receiver)
    assert (receiver.made, receiver.lost) == (1, [])
