"""A reload that changes only rates, limits, speeds and policies does not touch what moves: for every protocol."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from servobus.errors import Busy, LimitError
from servobus.rig.local import LocalRig, open_rig
from servobus.values import Reload
from tests.virtual_time import virtual

BUSES = {
    "sts": ("protocol: sms, baudrate: 1000000", "id: 1, model: sts"),
    "sms": ("protocol: sms, baudrate: 115200", "id: 1, model: sms"),
    "sms_cl": ("protocol: sms, baudrate: 115200", "id: 1, model: sms_cl"),
    "scs": ("protocol: sms, baudrate: 1000000", "id: 1, model: scs"),
    "kst": ("protocol: kst, baudrate: 512000", "id: 1"),
    "roh": ("protocol: roh, baudrate: 115200", "id: 2, channel: index"),
}
every_protocol = pytest.mark.parametrize("protocol", BUSES)
GOAL = 60.0


def write(path: Path, protocol: str, *, bus: str = "poll: {feedback: 50}", keys: str = "speed: 40") -> None:
    line, servo = BUSES[protocol]
    path.write_text(f'version: 1\nbuses:\n  arm: {{port: "sim:", {line}, {bus}, servos: {{s1: {{{servo}, {keys}}}}}}}\n')


async def position(rig: LocalRig) -> float:
    state = await rig["s1"].read()
    assert state.position is not None
    return state.position


@every_protocol
@pytest.mark.parametrize(
    ("bus", "keys"),
    [
        ("poll: {feedback: 40}", "speed: 40"),
        ("poll: {feedback: 50, health: 1}, goal_rate: 20", "speed: 40"),
        ("poll: {feedback: 50}", "speed: 30, max_speed: 50, max_step: 80, ttl: 1.0"),
        ("poll: {feedback: 50}", "speed: 40, limits: [0, 70], on_limit: clamp"),
        ("poll: {feedback: 50}", "speed: 40, on_exit: park, on_estop: park, on_lost_client: park, park_pose: 5, park_timeout: 2"),
    ],
)
@virtual
async def test_a_servo_goes_on_to_its_goal_while_its_bus_takes_new_options(
    protocol: str, bus: str, keys: str, tmp_path: Path
) -> None:
    path = tmp_path / "rig.yaml"
    write(path, protocol)
    async with open_rig(path) as rig:
        before = rig.buses["arm"]
        await rig.enable()
        await rig["s1"].move_to(GOAL)
        await asyncio.sleep(0.5)
        here = await position(rig)
        write(path, protocol, bus=bus, keys=keys)
        assert await rig.reload() == Reload(updated=("arm",))
        assert rig.buses["arm"] is before
        assert rig.snapshot()["arm/s1"].enabled
        await asyncio.sleep(0.2)
        assert await position(rig) > here, "it neither stopped nor went back"
        settled = (await rig["s1"].settle()).position
        assert settled is not None
        assert abs(settled - GOAL) < 2
        write(path, protocol)  # so that the end does not park


@every_protocol
@virtual
async def test_new_limits_and_rates_are_in_force_at_once(protocol: str, tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    write(path, protocol)
    async with open_rig(path) as rig:
        await rig.enable()
        write(path, protocol, bus="poll: {feedback: 10}", keys="limits: [0, 20]")
        await rig.reload()
        with pytest.raises(LimitError, match="outside 0 to 20"):
            await rig["s1"].move_to(30)
        await asyncio.sleep(1)
        polled = rig.stats()["arm"]["polled"]
        await asyncio.sleep(2)
        assert 19 <= rig.stats()["arm"]["polled"] - polled <= 21


@every_protocol
@pytest.mark.parametrize("keys", ["zero: 100", "direction: -1", "gear: 2"])
@virtual
async def test_another_calibration_is_refused_while_the_servo_is_enabled(protocol: str, keys: str, tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    write(path, protocol)
    async with open_rig(path) as rig:
        await rig.enable()
        write(path, protocol, keys=f"speed: 40, {keys}")
        with pytest.raises(Busy, match="arm/s1"):
            await rig.reload()
        assert rig.snapshot()["arm/s1"].enabled
