"""A servo that restarted, or lost its torque, is not energised by the next goal: on every protocol, with and without polls."""

from __future__ import annotations

import asyncio
import random
from pathlib import Path
from typing import Any

import pytest

from servobus.engine.health import MAX_BACKOFF
from servobus.errors import NotEnabled, ServobusError
from servobus.rig.local import LocalRig, open_rig
from tests.rig.test_owed_stops import PROTOCOLS, device, rig_config
from tests.simulated_rigs import config, devices
from tests.virtual_time import virtual

POLLS = {"no polls": "", "health once a second": "poll: {health: 1}", "feedback": "poll: {feedback: 50, health: 2}"}
FEETECH = [name for name in PROTOCOLS if name not in ("kst", "roh")]


def torque(rig: LocalRig) -> int:
    return int(device(rig).get("torque_enable"))


@pytest.mark.slow
@pytest.mark.parametrize("polls", POLLS)
@pytest.mark.parametrize("protocol", FEETECH)
@virtual
async def test_no_goal_energises_a_servo_after_a_restart(protocol: str, polls: str) -> None:
    """The servo is silent for 0 to 2 s, at a random moment; a goal comes some time later."""
    chance = random.Random(f"{protocol} {polls}")
    for _ in range(12):
        async with open_rig(rig_config(protocol, bus_keys=POLLS[polls])) as rig:
            await rig.enable("s1")
            await rig["s1"].move_to(chance.uniform(-20, 20))
            await asyncio.sleep(chance.uniform(0, 1))
            servo = device(rig)
            servo.dead = True
            await asyncio.sleep(chance.uniform(0, 2))
            servo.restart(asyncio.get_running_loop().time())
            servo.dead = False
            await asyncio.sleep(max(0.021, chance.uniform(0, 1)))
            with pytest.raises(ServobusError):
                await rig["s1"].move_to(chance.uniform(-20, 20))
            assert torque(rig) == 0
            await asyncio.sleep(MAX_BACKOFF + 0.5)  # by then it was probed, also where it was offline for long
            with pytest.raises(NotEnabled):
                await rig["s1"].move_to(5)
            assert torque(rig) == 0
            with pytest.raises(NotEnabled):
                await rig.settle("s1")


@pytest.mark.parametrize("protocol", FEETECH)
@virtual
async def test_torque_that_a_protection_switched_off_remains_off(protocol: str) -> None:
    async with open_rig(rig_config(protocol, bus_keys="poll: {feedback: 50}")) as rig:
        events = rig.events()
        await rig.enable("s1")
        await rig["s1"].move_to(10)
        await rig.settle("s1")
        servo = device(rig)
        servo.apply(40, b"\x00", asyncio.get_running_loop().time())
        await asyncio.sleep(0.05)
        state = rig.state("s1")
        assert (state.enabled, state.energised) == (False, False)
        with pytest.raises(NotEnabled, match="enable"):
            await rig["s1"].move_to(20)
        assert torque(rig) == 0
        names = []
        while "torque_lost" not in names:
            names.append((await anext(events)).name)
        assert "servo_restarted" not in names


@pytest.mark.parametrize("protocol", FEETECH)
@virtual
async def test_a_stream_does_not_energise_a_servo_that_lost_its_torque(protocol: str) -> None:
    async with open_rig(rig_config(protocol)) as rig:
        await rig.enable("s1")
        servo = device(rig)
        errors: list[type[ServobusError]] = []

        async def stream() -> None:
            for count in range(100):
                try:
                    await rig["s1"].move_to(count / 10)
                except ServobusError as error:
                    errors.append(type(error))
                await asyncio.sleep(0.025)

        streaming = asyncio.create_task(stream())
        await asyncio.sleep(1)
        servo.apply(40, b"\x00", asyncio.get_running_loop().time())
        await streaming
        assert torque(rig) == 0
        assert set(errors) == {NotEnabled}
        assert len(errors) > 50


@pytest.mark.parametrize("verb", ["stop", "exit", "lost client"])
@virtual
async def test_a_hold_does_not_energise_a_servo_that_lost_its_torque(verb: str) -> None:
    async with open_rig(config("s1: {id: 1, model: sts}", poll="{feedback: 50}")) as rig:
        await rig.enable()
        await rig["s1"].move_to(10)
        await rig.settle("s1")
        servo = devices(rig)[1]
        servo.apply(40, b"\x00", asyncio.get_running_loop().time())
        if verb == "stop":
            await rig.stop()
        elif verb == "lost client":
            await rig.abandon(["arm/s1"])
    assert servo.get("torque_enable") == 0


@virtual
async def test_settle_tells_why_a_motion_was_cut_short(tmp_path: Path) -> None:
    causes: dict[str, Any] = {
        "stop": lambda rig: rig.stop(),
        "disable": lambda rig: rig.disable("s1"),
        "lost client": lambda rig: rig.abandon(["arm/s1"]),
    }
    for name, cause in causes.items():
        async with open_rig(config("s1: {id: 1, model: sts, speed: 20}")) as rig:
            await rig.enable()
            await rig["s1"].move_to(60)
            await asyncio.sleep(0.1)
            settling = asyncio.create_task(rig.settle("s1"))
            await asyncio.sleep(0.1)
            await cause(rig)
            if name == "stop":
                await rig.clear()
            with pytest.raises(ServobusError):
                await settling
            with pytest.raises(ServobusError, match="before"):
                await rig.settle("s1")


@virtual
async def test_a_servo_that_had_arrived_was_not_cut_short_by_a_stop() -> None:
    async with open_rig(config("s1: {id: 1, model: sts}")) as rig:
        await rig.enable()
        await rig["s1"].move_to(10)
        await rig.settle("s1")
        await rig.stop()
        await rig.clear()
        assert (await rig.settle("s1"))["arm/s1"].position == pytest.approx(10, abs=0.9)


@pytest.mark.parametrize("protocol", PROTOCOLS)
@virtual
async def test_a_servo_that_is_enabled_anew_on_its_way_is_held(protocol: str) -> None:
    async with open_rig(rig_config(protocol)) as rig:
        await rig.enable("s1")
        await rig["s1"].move_to(60)
        await asyncio.sleep(0.3)
        await rig.enable("s1")
        before = (await rig.read("s1")).position
        await asyncio.sleep(0.5)
        assert (await rig.read("s1")).position == pytest.approx(before, abs=0.5)
        assert rig.state("s1").enabled
        await rig["s1"].move_to(70)
        assert (await rig.settle("s1"))["arm/s1"].position == pytest.approx(70, abs=1)
