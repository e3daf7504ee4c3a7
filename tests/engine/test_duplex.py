"""Full duplex: the next question travels while the last answer comes, and answers of two servos never meet."""

from __future__ import annotations

import asyncio
import random

import pytest

from servobus.config.loader import parse_config
from servobus.engine.duplex import DuplexEngine
from servobus.engine.engine import WaitUntil
from servobus.errors import ReplyTimeout
from servobus.protocols.kst.simulated.device import KstDevice
from servobus.rig.local import LocalRig, open_rig
from servobus.simulation.link import SimulatedLink
from tests.virtual_time import virtual

SERVOS = 12
FRAME = 14 * 10 / 512_000


def config(duplex: str, *, delays: str = "[0, 0.5]", **keys: str):  # type: ignore[no-untyped-def]
    more = "".join(f"    {key}: {value}\n" for key, value in keys.items())
    servos = "".join(f"      k{number}: {{id: {number}}}\n" for number in range(1, SERVOS + 1))
    head = "version: 1\nbuses:\n  line:\n    protocol: kst\n    port: 'sim:'\n"
    return parse_config(f"{head}    duplex: {duplex}\n    reply_delay_ms: {delays}\n{more}    servos:\n{servos}", "test")


def link_of(rig: LocalRig) -> SimulatedLink:
    link = rig.supervisors["line"].link
    assert isinstance(link, SimulatedLink)
    return link


def devices(rig: LocalRig) -> list[KstDevice]:
    return [device for device in link_of(rig).line.devices if isinstance(device, KstDevice)]


async def read_all(rig: LocalRig, rounds: int) -> float:
    """Seconds for so many reads of each servo."""

    async def caller(name: str) -> None:
        for _ in range(rounds):
            await rig.read_register(name, "position")

    loop = asyncio.get_running_loop()
    began = loop.time()
    await asyncio.gather(*(caller(f"k{number}") for number in range(1, SERVOS + 1)))
    return loop.time() - began


@pytest.mark.parametrize("max_delay_ms", [0.0, 0.1, 0.3, 0.5, 1.0, 2.0])
@virtual
async def test_answers_never_meet_over_the_whole_range_of_delays(max_delay_ms: float) -> None:
    rng = random.Random(max_delay_ms)
    async with open_rig(config("full", delays=f"[0, {max_delay_ms}]")) as rig:
        for _ in range(40):
            for device in devices(rig):
                device.delay = rng.choice((0.0, max_delay_ms / 1000, rng.uniform(0, max_delay_ms / 1000)))
            await read_all(rig, 3)
        assert link_of(rig).line.collisions == 0
        assert rig.stats()["line"].get("timeouts", 0) == 0


@virtual
async def test_it_is_nearly_twice_as_fast() -> None:
    seconds = {}
    for duplex in ("half", "full"):
        async with open_rig(config(duplex, delays="[0.05, 0.05]")) as rig:
            for device in devices(rig):
                device.delay = 0.000_05
            seconds[duplex] = await read_all(rig, 50)
    assert seconds["half"] == pytest.approx(SERVOS * 50 * (2 * FRAME + 0.000_05), rel=0.02)
    assert seconds["full"] == pytest.approx(SERVOS * 50 * FRAME, rel=0.02)


@virtual
async def test_values_are_those_of_the_servo_that_was_asked() -> None:
    async with open_rig(config("full")) as rig:
        for device in devices(rig):
            device.position = device.goal = float(10 * device.node)
        for _ in range(20):
            values = await asyncio.gather(*(rig.read_register(f"k{number}", "position") for number in range(1, SERVOS + 1)))
            assert values == [float(number) for number in range(1, SERVOS + 1)]


@virtual
async def test_after_a_missing_answer_it_is_half_duplex_for_a_while() -> None:
    async with open_rig(config("full", delays="[0.2, 0.25]")) as rig:
        for device in devices(rig):
            device.delay = 0.000_2
        await read_all(rig, 1)
        devices(rig)[3].dead = True
        with pytest.raises(ReplyTimeout):
            await rig.read_register("k4", "position")
        bus = rig.buses["line"]
        now = bus.clock()
        assert isinstance(bus.engine, DuplexEngine)
        assert bus.engine.half_until > now
        half = await read_all_but(rig, 4, 5)
        devices(rig)[3].dead = False
        await asyncio.sleep(10)
        full = await read_all_but(rig, 4, 5)
        assert full < 0.8 * half
        assert link_of(rig).line.collisions == 0


async def read_all_but(rig: LocalRig, missing: int, rounds: int) -> float:
    async def caller(name: str) -> None:
        for _ in range(rounds):
            await rig.read_register(name, "position")

    loop = asyncio.get_running_loop()
    began = loop.time()
    await asyncio.gather(*(caller(f"k{number}") for number in range(1, SERVOS + 1) if number != missing))
    return loop.time() - began


@virtual
async def test_several_questions_to_one_servo_wait_for_each_other() -> None:
    async with open_rig(config("full")) as rig:
        values = await asyncio.gather(*(rig.read_register("k1", "position") for _ in range(20)))
        assert values == [0.0] * 20
        assert rig.stats()["line"].get("strays", 0) == 0


@virtual
async def test_goals_and_the_e_stop_on_four_wires() -> None:
    async with open_rig(config("full", poll="{feedback: 50}")) as rig:
        await rig.enable()
        await rig.move({f"k{number}": 10.0 for number in range(1, SERVOS + 1)}, together=True)
        await asyncio.sleep(0.1)
        reports = await rig.stop()
        assert all(report.confirmed for report in reports.values())
        assert link_of(rig).line.collisions == 0


@virtual
async def test_a_lost_line_ends_every_turn_in_flight() -> None:
    async with open_rig(config("full")) as rig:
        for device in devices(rig):
            device.delay = 0.005
        calls = [asyncio.create_task(rig.read_register(f"k{number}", "position")) for number in range(1, SERVOS + 1)]
        await asyncio.sleep(0.002)
        assert rig.buses["line"].engine.in_flight > 1
        link_of(rig).unplug()
        results = await asyncio.gather(*calls, return_exceptions=True)
        assert all(type(result).__name__ == "LinkDown" for result in results), results


@virtual
async def test_a_plan_waits_until_the_line_is_empty_and_has_it_alone() -> None:
    async with open_rig(config("full", delays="[0.2, 0.2]")) as rig:
        reading = [asyncio.create_task(rig.read_register(f"k{number}", "position")) for number in range(1, SERVOS + 1)]
        await asyncio.sleep(0)
        identities = await asyncio.gather(*(rig.identify(f"k{number}") for number in (1, 2, 3)))
        assert [identity.model for identity in identities] == ["kst"] * 3
        assert await asyncio.gather(*reading) == [0.0] * SERVOS
        assert link_of(rig).line.collisions == 0


@virtual
async def test_while_a_plan_waits_for_the_turn_under_way_nothing_else_wakes_the_engine() -> None:
    """What is due meanwhile waits for that plan: to wake up for it would be to wake up again and again."""
    async with open_rig(config("full")) as rig:
        await rig.enable("k2")
        await asyncio.sleep(0.1)
        bus = rig.buses["line"]
        devices(rig)[0].dead = True
        reading = asyncio.create_task(rig.read_register("k1", "position"))
        moving = asyncio.create_task(rig["k2"].move_to(10))
        await asyncio.sleep(0.001)
        now = bus.clock()
        bus.scheduler.set_polls(bus.driver.polls({"feedback": 50}), now - 1)
        assert bus.engine.in_flight == 1
        action = bus.engine.next_action(now)
        assert not isinstance(action, WaitUntil) or action.when > now
        await moving
        with pytest.raises(ReplyTimeout):
            await reading
