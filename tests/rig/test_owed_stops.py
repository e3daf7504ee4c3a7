"""A stop is owed until the servo has confirmed it: for servos that are not heard when it is asked for, on every protocol."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

import pytest

from servobus.config.loader import Config, parse_config
from servobus.errors import ServobusError
from servobus.rig.local import LocalRig, open_rig
from servobus.simulation.link import SimulatedLink
from servobus.values import Health
from tests.simulated_rigs import config, devices
from tests.virtual_time import virtual
from tests.waiting import until
from tests.wire_log import WireLog

PROTOCOLS = {
    "sts": "protocol: sms, baudrate: 1000000, servos: {{s1: {{id: 1, model: sts, speed: 20{keys}}}, s2: {{id: 2, model: sts}}}}",
    "sms": "protocol: sms, baudrate: 115200, servos: {{s1: {{id: 1, model: sms, speed: 20{keys}}}, s2: {{id: 2, model: sms}}}}",
    "sms_cl": (
        "protocol: sms, baudrate: 115200, servos: {{s1: {{id: 1, model: sms_cl, speed: 20{keys}}}, s2: {{id: 2, model: sms_cl}}}}"
    ),
    "scs": "protocol: sms, baudrate: 1000000, servos: {{s1: {{id: 1, model: scs, speed: 20{keys}}}, s2: {{id: 2, model: scs}}}}",
    "kst": "protocol: kst, baudrate: 512000, servos: {{s1: {{id: 1, speed: 20{keys}}}, s2: {{id: 2}}}}",
    "roh": (
        "protocol: roh, baudrate: 115200, "
        "servos: {{s1: {{id: 2, channel: index, speed: 10{keys}}}, s2: {{id: 3, channel: index}}}}"
    ),
}
GOAL = 80.0


def rig_config(protocol: str, *, keys: str = "", bus_keys: str = "") -> Config:
    text = PROTOCOLS[protocol].format(keys=keys and f", {keys}")
    return parse_config(f'version: 1\nbuses:\n  arm: {{port: "sim:", {text}{bus_keys and f", {bus_keys}"}}}\n', "test", Path())


def device(rig: LocalRig) -> Any:
    """The simulated node that carries s1."""
    return cast("SimulatedLink", rig.supervisors["arm"].link).line.devices[0]


async def travels(rig: LocalRig) -> bool:
    """Return whether s1 is somewhere else half a second later."""
    before = (await rig.read("s1")).position
    await asyncio.sleep(0.5)
    after = (await rig.read("s1")).position
    assert before is not None
    assert after is not None
    return abs(after - before) > 0.5


@pytest.mark.parametrize("silence", [0.03, 0.6, 1.5])
@pytest.mark.parametrize("protocol", PROTOCOLS)
@virtual
async def test_a_servo_that_was_deaf_during_the_e_stop_is_stopped_when_it_is_heard(protocol: str, silence: float) -> None:
    async with open_rig(rig_config(protocol)) as rig:
        await rig.enable()
        events = rig.events()
        await rig["s1"].move_to(GOAL)
        await asyncio.sleep(0.2)
        device(rig).dead = True
        reports = await rig.stop()
        assert not reports["arm/s1"].confirmed
        assert reports["arm/s2"].confirmed
        await asyncio.sleep(silence)
        device(rig).dead = False
        await asyncio.sleep(1.0)
        assert not await travels(rig)
        position = (await rig.read("s1")).position
        assert position is not None
        assert position < GOAL - 1, "it was stopped on its way"
        assert rig.buses["arm"].stops.owed == {}
        names = []
        while "stop_paid" not in names:
            names.append((await anext(events)).name)
        assert "stop_owed" in names


@pytest.mark.parametrize("protocol", PROTOCOLS)
@virtual
async def test_a_servo_that_is_offline_at_the_e_stop_is_stopped_when_it_is_heard(protocol: str) -> None:
    async with open_rig(rig_config(protocol, bus_keys="poll: {feedback: 20}")) as rig:
        await rig.enable()
        await rig["s1"].move_to(GOAL)
        await asyncio.sleep(0.2)
        device(rig).dead = True
        await until(lambda: rig.state("s1").health is Health.OFFLINE)
        await rig.stop()
        await asyncio.sleep(0.3)
        device(rig).dead = False
        await asyncio.sleep(1.0)
        assert not await travels(rig)
        assert rig.buses["arm"].stops.owed == {}


@pytest.mark.parametrize("protocol", PROTOCOLS)
@virtual
async def test_on_a_lossy_line_every_servo_is_stopped_in_the_end(protocol: str) -> None:
    async with open_rig(rig_config(protocol, bus_keys="faults: {loss: 0.3, seed: 4}")) as rig:
        while not all(state.enabled for state in rig.snapshot().values()):
            with suppress(ServobusError):  # the line loses replies
                await rig.enable()
        with suppress(ServobusError):
            await rig.move({"s1": GOAL})
        await asyncio.sleep(0.1)
        await rig.stop()
        await asyncio.sleep(2.0)
        assert rig.buses["arm"].stops.owed == {}


@virtual
async def test_enable_ends_the_debt_of_a_stop() -> None:
    async with open_rig(config()) as rig:
        await rig.enable()
        devices(rig)[1].dead = True
        await rig.stop()
        assert rig.buses["arm"].stops.owed == {"s1": "hold"}
        await rig.clear()
        devices(rig)[1].dead = False
        await asyncio.sleep(1.0)
        assert rig.buses["arm"].stops.owed == {}
        await rig.enable("s1")
        await rig["s1"].move_to(10)
        assert (await rig.settle("s1"))["arm/s1"].position == pytest.approx(10, abs=1)


@virtual
async def test_the_exit_waits_for_a_servo_that_is_heard_again_in_time() -> None:
    async with open_rig(config("s1: {id: 1, model: sts, on_exit: limp}")) as rig:
        await rig.enable()
        servo = devices(rig)[1]
        servo.dead = True
        asyncio.get_running_loop().call_later(0.4, setattr, servo, "dead", False)
    assert rig.left["arm/s1"].confirmed
    assert servo.get("torque_enable") == 0


@virtual
async def test_a_limp_stop_is_told_again_with_each_probe() -> None:
    log = WireLog()
    async with open_rig(config("s1: {id: 1, model: sts, on_estop: limp}", "s2: {id: 2, model: sts}"), trace=log) as rig:
        await rig.enable()
        devices(rig)[1].dead = True
        await rig.stop()
        await until(lambda: rig.state("s1").health is Health.OFFLINE)
        del log.sent_frames[:]
        await asyncio.sleep(2.0)
        blind = [frame for frame in log.sent_frames if frame[4] == 0x83 or (frame[4] == 3 and frame[5] == 40)]
        assert len(blind) >= 4, "torque off is sent with every probe, and the probes stay frequent"
