"""The client that moved a servo is gone: its servos do their `on_lost_client`, and nobody else is disturbed."""

from __future__ import annotations

import asyncio

import pytest

from servobus.errors import EStopped, LeaseHeld, NotEnabled
from servobus.rig.local import open_rig
from servobus.values import Outcome
from tests.simulated_rigs import config, devices
from tests.virtual_time import virtual

HOLD = "s1: {id: 1, model: sts, speed: 20}"
LIMP = "s2: {id: 2, model: sts, speed: 20, on_lost_client: limp}"
PARK = "s3: {id: 3, model: sts, on_lost_client: park, park_pose: 10}"
OTHER = "s4: {id: 4, model: sts, speed: 20}"


@virtual
async def test_each_does_what_its_config_says() -> None:
    async with open_rig(config(HOLD, LIMP, PARK, OTHER)) as rig:
        await rig.enable()
        await rig.move({"s1": 60, "s2": 60, "s3": 60, "s4": 60})
        await asyncio.sleep(0.5)
        reports = await rig.abandon(["arm/s1", "arm/s2", "arm/s3"])
        assert {name: (report.action, report.confirmed) for name, report in reports.items()} == {
            "arm/s1": ("hold", True),
            "arm/s2": ("limp", True),
            "arm/s3": ("park", True),
        }
        states = {name.partition("/")[2]: await rig.read(name) for name in rig.names}
        assert not states["s1"].moving
        assert 5 < (states["s1"].position or 0) < 20, "it stands where it was told to"
        assert states["s3"].position == pytest.approx(10, abs=1)
        assert {name for name, state in states.items() if state.enabled} == {"s1", "s4"}
        assert {node for node, device in devices(rig).items() if device.get("torque_enable")} == {1, 4}
        assert (await rig["s4"].settle()).position == pytest.approx(60, abs=1), "nobody else is stopped"


@virtual
async def test_only_the_goals_of_the_lost_client_are_dropped() -> None:
    async with open_rig(config(HOLD, OTHER)) as rig:
        await rig.enable()
        reading = asyncio.create_task(rig["s4"].read())
        await asyncio.sleep(0)
        goals = [asyncio.create_task(rig[name].move_to(30)) for name in ("s1", "s4")]
        await asyncio.sleep(0)  # both wait for the end of that turn
        reports = await rig.abandon(["arm/s1"])
        lost, kept = await asyncio.gather(*goals, return_exceptions=True)
        assert isinstance(lost, LeaseHeld)
        assert "is gone" in str(lost)
        assert kept is Outcome.ACKED
        assert reports["arm/s1"].confirmed
        await reading


@virtual
async def test_one_that_is_not_enabled_is_left_alone() -> None:
    async with open_rig(config(HOLD, OTHER)) as rig:
        assert await rig.abandon(["arm/s1"]) == {}
        assert devices(rig)[1].get("torque_enable") == 0


@virtual
async def test_on_a_line_that_is_down_it_says_so() -> None:
    async with open_rig(config(HOLD)) as rig:
        await rig.enable()
        rig.supervisors["arm"].scope.cancel()
        await rig.supervisors["arm"].bus.master.close()
        report = (await rig.abandon(["arm/s1"]))["arm/s1"]
        assert (report.written, report.confirmed) == (False, False)
        assert "line is down" in report.detail


@virtual
async def test_an_e_stop_goes_before_it() -> None:
    async with open_rig(config(HOLD, OTHER)) as rig:
        await rig.enable()
        await rig.move({"s1": 60, "s4": 60})
        lost, stopped = await asyncio.gather(rig.abandon(["arm/s1"]), rig.stop())
        assert stopped["arm/s1"].confirmed
        assert stopped["arm/s4"].confirmed
        assert lost["arm/s1"].action == "hold"
        with pytest.raises(EStopped):
            await rig["s1"].move_to(0)


@virtual
async def test_a_plan_of_another_is_not_torn() -> None:
    async with open_rig(config(HOLD, OTHER, "s5: {id: 5, model: sts, speed: 20}")) as rig:
        await rig.enable()
        moving = asyncio.create_task(rig.move({"s4": 30, "s5": 30}, together=True, confirm=True))
        for _ in range(3):
            await asyncio.sleep(0)
        await rig.abandon(["arm/s1"])
        assert await moving == {"arm/s4": Outcome.ACKED, "arm/s5": Outcome.ACKED}


@virtual
async def test_one_gone_limp_needs_to_be_enabled_again() -> None:
    async with open_rig(config(LIMP)) as rig:
        await rig.enable()
        await rig.abandon(["arm/s2"])
        with pytest.raises(NotEnabled):
            await rig["s2"].move_to(5)
        await rig.enable("s2")
        assert await rig["s2"].move_to(5) is Outcome.ACKED
