"""A scan asks every id at every rate, once, alone on the line, and leaves it as it was."""

from __future__ import annotations

import asyncio
from contextlib import aclosing

import pytest

from servobus.bus.scan import scan
from servobus.errors import LinkDown, NotSupported
from servobus.protocols.base import LineTraits
from servobus.protocols.sms.codec import Instruction
from tests.engine.scripted_line import Answers, puppet_bus
from tests.virtual_time import virtual


@virtual
async def test_every_id_at_every_rate() -> None:
    async with puppet_bus() as (bus, puppet, _, _):
        puppet.script = lambda frame: [] if frame[2] not in (1, 5) else None
        steps = [step async for step in scan(bus, [1_000_000, 500_000], range(8))]
        assert [step[:2] for step in steps] == [(asked, 16) for asked in range(1, 17)]
        hits = [step[2] for step in steps if step[2] is not None]
        assert [(hit[0], hit[1]) for hit in hits] == [(1, 1_000_000), (5, 1_000_000), (1, 500_000), (5, 500_000)]
        pinged = [frame[2] for frame in puppet.frames if frame[4] == Instruction.PING]
        assert set(pinged) == set(range(8))
        assert bus.scheduler.session is None


@virtual
async def test_a_scan_that_is_left_gives_the_line_back_at_its_own_rate() -> None:
    async with puppet_bus() as (bus, _, _, _):
        own = bus.options.baudrate
        async with aclosing(scan(bus, [500_000, own], range(8))) as steps:
            await anext(steps)
            assert bus.line.traits.baudrate == 500_000
        assert bus.line.traits.baudrate == own
        assert bus.scheduler.session is None
        assert await bus.read_register("s1", "present_position", raw=True) == 0


@virtual
async def test_a_servo_that_answers_only_ping_is_a_hit_without_a_name() -> None:
    async with puppet_bus() as (bus, puppet, _, _):
        puppet.script = lambda frame: None if frame[4] == Instruction.PING and frame[2] == 9 else []
        hits = [hit async for _, _, hit in scan(bus, [bus.options.baudrate], [9]) if hit]
        assert len(hits) == 1
        assert hits[0][2] is None


@virtual
@pytest.mark.parametrize("there", [True, False])
async def test_an_answer_that_looks_like_the_question_is_asked_for_in_another_way(there: bool) -> None:
    """A servo whose health byte is 1 answers PING with the very bytes of PING; so does a line that echoes."""
    async with puppet_bus() as (bus, puppet, _, _):

        def script(frame: bytes) -> Answers | None:
            if frame[4] == Instruction.PING:
                return [(0.001, frame)]
            return None if there else []

        puppet.script = script
        hits = [hit async for _, _, hit in scan(bus, [bus.options.baudrate], [9]) if hit]
        assert [hit[0] for hit in hits] == ([9] if there else [])
        assert [frame[4] for frame in puppet.frames[:2]] == [Instruction.PING, Instruction.READ]


@virtual
async def test_a_line_that_goes_down_ends_the_scan() -> None:
    async with puppet_bus() as (bus, puppet, link, _):
        puppet.script = lambda frame: []
        asyncio.get_running_loop().call_later(0.1, link.unplug)
        with pytest.raises(LinkDown):
            async for _ in scan(bus, [bus.options.baudrate], range(200)):
                pass
        assert bus.scheduler.session is None


@virtual
async def test_a_line_whose_rate_is_set_elsewhere_is_scanned_at_that_rate_only() -> None:
    async with puppet_bus(traits=LineTraits()) as (bus, _, _, _):
        with pytest.raises(NotSupported, match="cannot change its baud rate"):
            await anext(scan(bus, [9600], [1]))
        assert (await anext(scan(bus, [bus.options.baudrate], [1])))[:2] == (1, 1)


@virtual
async def test_an_id_whose_reply_came_garbled_is_asked_again() -> None:
    async with puppet_bus() as (bus, puppet, _, _):
        garbled = [b"\x00\x13\x37", b"\xff\xff\x05\x02"]

        def script(frame: bytes) -> Answers | None:
            if frame[2] == 5:
                return [(0.001, garbled.pop())] if garbled else None
            return []

        puppet.script = script
        steps = [step async for step in scan(bus, [bus.options.baudrate], range(4, 7))]
        assert [step[2] is not None for step in steps] == [False, True, False]
        assert garbled == []
        assert len([frame for frame in puppet.frames if frame[2] == 4]) == 1, "silence is believed at once"
