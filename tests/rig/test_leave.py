"""The order at the end: everything holds or goes limp first, then servos park."""

from __future__ import annotations

import asyncio

import pytest

from servobus.rig.local import open_rig
from tests.simulated_rigs import config, devices
from tests.virtual_time import virtual

PARK = "{id: 1, model: sts, speed: 20, on_exit: park, park_pose: -60, park_timeout: 5}"


@pytest.mark.parametrize("policy", ["hold", "limp"])
@virtual
async def test_nothing_travels_on_while_another_servo_parks(policy: str) -> None:
    async with open_rig(config(f"s1: {PARK}", f"s2: {{id: 2, model: sts, speed: 20, on_exit: {policy}}}")) as rig:
        await rig.enable()
        await rig.move({"s1": 60, "s2": 60})
        await asyncio.sleep(0.5)
        second = devices(rig)[2]
        before = (await rig.read("s2")).position
        assert before is not None
    after = second.joint.position
    assert rig.left["arm/s1"].action == "park"
    assert rig.left["arm/s2"].confirmed
    assert abs((after - 2048) * 360 / 4096 - before) < 1, "it stopped when the exit began, not when s1 had parked"


@virtual
async def test_a_servo_that_parks_stops_before_it_goes_to_its_pose() -> None:
    async with open_rig(config(f"s1: {PARK}", f"s2: {PARK.replace('id: 1', 'id: 2')}")) as rig:
        await rig.enable()
        await rig.move({"s1": 60, "s2": 60})
        await asyncio.sleep(0.5)
    assert {name: (report.action, report.confirmed) for name, report in rig.left.items()} == {
        "arm/s1": ("park", True),
        "arm/s2": ("park", True),
    }
    assert [device.get("torque_enable") for device in devices(rig).values()] == [0, 0]
