"""The rig's stops, restarts and replugs, and what may be read meanwhile, on simulated servos in virtual time."""

from __future__ import annotations

import asyncio

import pytest

from servobus.errors import (
    Busy,
    EStopped,
    LimitError,
    LinkDown,
    NotEnabled,
    NotSupported,
    PartialFailure,
    PortMissing,
    SettleTimeout,
    UnknownName,
)
from servobus.protocols.sms.codec import Instruction
from servobus.rig.local import open_rig
from servobus.values import Goal, Outcome
from tests.simulated_rigs import config, devices
from tests.virtual_time import virtual
from tests.wire_log import GOAL, WireLog, energised, frames

# Stop


@virtual
async def test_stop_holds_limps_and_latches() -> None:
    async with open_rig(config()) as rig:
        await rig.enable()
        await rig.move({"s1": 80, "s2": 80, "s3": 80})
        await asyncio.sleep(0.2)
        reports = await rig.stop()
        assert {name: (report.action, report.confirmed) for name, report in reports.items()} == {
            "arm/s1": ("hold", True),
            "arm/s2": ("hold", True),
            "arm/s3": ("limp", True),
        }
        assert [energised(device) for device in devices(rig).values()] == [True, True, False]
        stopped = (await rig.read("s1")).position
        await asyncio.sleep(1)
        assert (await rig.read("s1")).position == stopped
        before = frames(rig)
        for refused in (rig["s1"].move_to(0), rig.enable("s1")):
            with pytest.raises(EStopped, match="clear"):
                await refused
        assert frames(rig) == before
        await rig.clear()
        assert not rig.stopped
        await asyncio.sleep(0.5)
        assert (await rig.read("s1")).position == stopped
        assert await rig["s1"].move_to(0) is Outcome.ACKED


@virtual
async def test_hold_never_energises_what_was_limp() -> None:
    async with open_rig(config()) as rig:
        reports = await rig.stop()
        assert reports["arm/s1"].action == "none"
        assert not any(energised(device) for device in devices(rig).values())


@virtual
async def test_stop_parks_and_then_goes_limp() -> None:
    servo = "s1: {id: 1, model: sts, on_estop: park, park_pose: -20, on_exit: limp}"
    async with open_rig(config(servo)) as rig:
        await rig.enable()
        await rig["s1"].move_to(40)
        await rig["s1"].settle()
        assert (await rig.stop())["arm/s1"].action == "hold"
        with pytest.raises(Busy, match="park"):
            await rig.clear()
        await asyncio.sleep(6)
        device = devices(rig)[1]
        assert (await rig.read("s1")).position == pytest.approx(-20, abs=0.9)
        assert not energised(device)
        await rig.clear()


@virtual
async def test_stop_reports_a_servo_that_is_gone() -> None:
    async with open_rig(config()) as rig:
        await rig.enable()
        devices(rig)[2].dead = True
        reports = await rig.stop()
        assert reports["arm/s1"].confirmed
        assert not reports["arm/s2"].confirmed


@virtual
async def test_disable_is_for_one_servo_and_no_e_stop() -> None:
    async with open_rig(config()) as rig:
        await rig.enable()
        await rig.disable("s1")
        assert [energised(device) for device in devices(rig).values()] == [False, True, True]
        assert not rig.stopped


# Restart and plug


@virtual
async def test_a_restarted_servo_is_disabled_and_its_goal_not_repeated() -> None:
    async with open_rig(config(poll="{feedback: 50}")) as rig:
        await rig.enable()
        await rig["s1"].move_to(20)
        await rig["s1"].settle()
        device = devices(rig)[1]
        device.reboot(asyncio.get_running_loop().time())
        await asyncio.sleep(5)
        assert rig.stats()["arm"]["restarts"] == 1
        assert not energised(device)
        assert device.get(GOAL) == 0
        with pytest.raises(NotEnabled):
            await rig["s1"].move_to(20)
        assert rig.snapshot()["arm/s2"].enabled


@virtual
async def test_unplug_fails_what_waits_and_replug_sends_no_old_goal() -> None:
    wire = WireLog()
    async with open_rig(config(poll="{feedback: 50}"), trace=wire) as rig:
        await rig.enable()
        link = rig.supervisors["arm"].link
        waiting = [asyncio.create_task(rig.read(f"s{number}")) for number in (1, 2, 3)]
        moving = asyncio.create_task(rig.move({"s1": 50, "s2": 50}))
        await asyncio.sleep(0)
        link.unplug()  # type: ignore[attr-defined]
        results = await asyncio.gather(*waiting, return_exceptions=True)
        assert all(isinstance(result, LinkDown) for result in results), results
        with pytest.raises(PartialFailure):
            await moving
        with pytest.raises(LinkDown):
            await rig["s1"].move_to(3)
        wire.sent_frames.clear()
        link.plug()  # type: ignore[attr-defined]
        await asyncio.sleep(1)
        assert (await rig.read("s1")).position == 0
        assert wire.instructions() <= {Instruction.PING, Instruction.READ, Instruction.SYNC_READ}


@virtual
async def test_a_port_that_is_missing_is_an_error_or_waited_for() -> None:
    with pytest.raises(PortMissing, match="arm"):
        async with open_rig(config(port="/dev/no-such-port")):
            raise AssertionError
    async with open_rig(config(port="/dev/no-such-port"), degraded=True) as rig:
        with pytest.raises(LinkDown, match="arm/s1"):
            await rig.read("s1")


# Reading, names, sessions


@virtual
async def test_read_returns_the_last_poll_when_it_is_fresh_enough() -> None:
    async with open_rig(config(poll="{feedback: 50}")) as rig:
        await asyncio.sleep(0.1)
        before = frames(rig)
        state = await rig["s1"].read(max_age=1.0)
        assert frames(rig) == before
        assert state.age is not None
        assert state.age <= 0.03
        await rig["s1"].read()
        assert frames(rig) == before + 1


@virtual
async def test_watch_gives_snapshots() -> None:
    async with open_rig(config(poll="{feedback: 50}")) as rig:
        snapshots = []
        async for snapshot in rig.watch(hz=20):
            snapshots.append(snapshot)
            if len(snapshots) == 3:
                break
        assert all(set(snapshot) == {"arm/s1", "arm/s2", "arm/s3"} for snapshot in snapshots)
        with pytest.raises(ValueError, match="0"):
            await anext(aiter(rig.watch(hz=0)))


@virtual
async def test_names() -> None:
    async with open_rig(config()) as rig:
        assert [servo.name for servo in rig] == ["arm/s1", "arm/s2", "arm/s3"]
        assert rig["arm/s2"].name == rig["s2"].name
        with pytest.raises(UnknownName, match="s1"):
            rig["elbow"]
        with pytest.raises(UnknownName, match="present_position"):
            await rig.read_register("s1", "positon")


@virtual
async def test_settle_says_where_it_stands() -> None:
    async with open_rig(config()) as rig:
        await rig.enable()
        devices(rig)[1].joint.stuck = True
        await rig["s1"].move_to(30)
        with pytest.raises(SettleTimeout, match="0"):
            await rig["s1"].settle(timeout=0.5)


@virtual
async def test_scan_finds_and_refuses_while_something_is_enabled() -> None:
    async with open_rig(config()) as rig:
        progress: list[int] = []
        hits = await rig.scan("arm", ids=range(4), progress=lambda asked, count, hit: progress.append(asked))
        assert [(hit.id, hit.model) for hit in hits] == [(1, "sts"), (2, "sts"), (3, "sts")]
        assert progress[-1] == 4
        await rig.enable("s1")
        with pytest.raises(Busy, match="s1"):
            await rig.scan("arm", ids=[1])
        with pytest.raises(UnknownName):
            await rig.scan("leg")


@virtual
async def test_scan_over_baud_rates_comes_back_to_the_own_one() -> None:
    async with open_rig(config()) as rig:
        device = devices(rig)[2]
        device.baudrate = 115200
        hits = await rig.scan("arm", baudrates=[115200, 1000000], ids=range(4))
        assert [(hit.id, hit.baudrate) for hit in hits] == [(2, 115200), (1, 1000000), (3, 1000000)]
        assert (await rig.read("s1")).position == 0


@virtual
async def test_a_goal_with_every_option() -> None:
    async with open_rig(
        config("s1: {id: 1, model: sts, max_speed: 180, max_step: 50, acceleration: 500, torque_limit: 80}")
    ) as rig:
        await rig.enable()
        device = devices(rig)[1]
        assert await rig.send("s1", Goal("position", 20, speed=90, effort=50)) is Outcome.ACKED
        assert device.get("torque_limit") == 500
        with pytest.raises(LimitError, match="max_step"):
            await rig["s1"].move_to(71)
        with pytest.raises(LimitError, match="speed"):
            await rig["s1"].move_to(30, speed=181)
        await rig["s1"].settle()
        assert await rig["s1"].move_to(0, duration=1.0) is Outcome.ACKED


@virtual
async def test_registers() -> None:
    async with open_rig(config()) as rig:
        servo = rig["s1"]
        assert await servo.read_register("id") == 1
        assert await servo.read_register("5:2") == [1, 0]
        assert await servo.write_register("torque_limit", 40) == 40
        assert await servo.read_register("torque_limit", raw=True) == 400
        for refused in ("goal_position", "torque_enable", "lock", "id"):
            with pytest.raises(NotSupported):
                await servo.write_register(refused, 1)
        with pytest.raises(NotSupported, match="persist"):
            await servo.write_register("return_delay", 10, raw=True)
        await servo.write_register("return_delay", 10, raw=True, persist=True)
        await servo.enable()
        with pytest.raises(NotSupported, match="disable"):
            await servo.write_register("return_delay", 20, raw=True, persist=True)
