"""One bus's verbs on a line that does what the test says: start, introductions, sessions, errors with their place."""

from __future__ import annotations

import asyncio

import pytest

from servobus.errors import Busy, EStopped, LinkDown, NotSupported, ReplyTimeout
from servobus.protocols.sms.codec import Instruction, encode
from tests.engine.scripted_line import puppet_bus
from tests.virtual_time import virtual


@virtual
async def test_start_without_a_servo_is_an_event() -> None:
    async with puppet_bus(started=False) as (bus, puppet, _, events):
        puppet.script = lambda frame: [] if frame[2] == 2 else None
        await bus.start()
        assert events.count("servo_missing") == 1
        assert "servo_offline" in events


@virtual
async def test_start_on_a_line_that_goes_down_ends() -> None:
    async with puppet_bus(started=False, echo="auto") as (bus, puppet, link, events):
        puppet.script = lambda frame: []
        starting = asyncio.create_task(bus.start())
        await asyncio.sleep(0.025)
        link.unplug()
        await starting
        assert "echo_probed" not in events
        assert not bus.master.up


@virtual
async def test_a_servo_that_comes_later_is_introduced() -> None:
    async with puppet_bus(started=False) as (bus, puppet, _, events):
        puppet.script = lambda frame: [] if frame[2] == 2 else None
        await bus.start()
        assert [record.identity is None for record in bus.records.values()] == [False, True]
        puppet.script = lambda frame: None
        await asyncio.sleep(5)
        assert bus.records["s2"].identity is not None
        assert "servo_online" in events


@virtual
async def test_one_that_answers_but_not_who_it_is_is_not_asked_all_the_time() -> None:
    async with puppet_bus(started=False) as (bus, puppet, _, _):
        question = bytes((Instruction.READ, 0))
        puppet.script = lambda frame: [] if frame[2] == 2 and frame[4:6] == question else None
        await bus.start()
        puppet.frames.clear()
        for _ in range(100):
            puppet.say(encode(2, 0))  # it speaks unasked, so it becomes doubtful, and online again
            await asyncio.sleep(0.1)
        asked = [frame for frame in puppet.frames if frame[2] == 2 and frame[4:6] == question]
        assert 0 < len(asked) <= 3 * 10


@virtual
async def test_notes_of_an_identity_are_reported_once() -> None:
    async with puppet_bus() as (bus, _, _, events):
        first = events.count("servo_note")
        assert first > 0, "a puppet is energised"
        await bus.identify("s1")
        assert events.count("servo_note") == first


@virtual
async def test_an_exclusive_session_has_the_line_alone() -> None:
    async with puppet_bus(poll="{feedback: 50}") as (bus, puppet, _, _):
        async with bus.exclusive() as session:
            puppet.frames.clear()
            waiting = asyncio.create_task(bus.read_register("s1", "present_position", raw=True))
            with pytest.raises(Busy, match="session"):
                await bus.motion.enable("s1")
            await asyncio.sleep(0.2)
            assert puppet.frames == []
            assert await bus.ask(bus.driver.ping(2), session=session) == 0
            assert len(puppet.frames) == 1
            assert not waiting.done()
            with pytest.raises(Busy):
                async with bus.exclusive():
                    raise AssertionError
        assert await waiting == 0
        await asyncio.sleep(0.1)
        assert len(puppet.frames) > 3, "polls go on"


@virtual
async def test_no_session_while_the_e_stop_holds_or_something_is_enabled() -> None:
    async with puppet_bus() as (bus, _, _, _):
        bus.records["s1"].enabled = True
        with pytest.raises(Busy, match="s1 is enabled"):
            async with bus.exclusive():
                raise AssertionError
        bus.records["s2"].enabled = True
        with pytest.raises(Busy, match="s1, s2 are enabled"):
            async with bus.exclusive():
                raise AssertionError
        await bus.stops.stop()
        with pytest.raises(EStopped):
            async with bus.exclusive():
                raise AssertionError


@virtual
async def test_eeprom_of_an_enabled_servo_is_not_written() -> None:
    async with puppet_bus() as (bus, puppet, _, _):
        bus.records["s1"].enabled = True
        puppet.frames.clear()
        with pytest.raises(NotSupported, match="arm/s1"):
            await bus.write_register("s1", "return_delay", 1, raw=True, persist=True)
        assert puppet.frames == []


@virtual
async def test_ping_looks_even_for_one_that_is_offline() -> None:
    async with puppet_bus() as (bus, puppet, _, _):
        puppet.script = lambda frame: [] if frame[2] == 1 else None
        with pytest.raises(ReplyTimeout):
            await bus.read_register("s1", "id")
        await asyncio.sleep(10)
        assert bus.state("s1").health == "offline"
        puppet.frames.clear()
        with pytest.raises(ReplyTimeout):
            await bus.ping("s1")
        assert puppet.frames
        puppet.script = lambda frame: None
        assert await bus.ping("s1") == 0
        assert bus.state("s1").health == "online"


@virtual
async def test_a_plan_on_a_line_that_is_down_is_closed() -> None:
    async with puppet_bus() as (bus, _, link, _):
        link.unplug()
        await asyncio.sleep(0)
        with pytest.raises(LinkDown, match="arm/s1"):
            await bus.identify("s1")
        bus.set_baudrate(115200)
        assert bus.line.traits.baudrate is None, "there is nothing to be told"
