"""The rig as its users know it, on simulated servos in virtual time: what is refused, what is sent, what is left behind."""

from __future__ import annotations

import asyncio
import math

import pytest

from servobus.errors import GoalExpired, LimitError, NotEnabled, NotSupported, PartialFailure, ReplyTimeout
from servobus.protocols.sms.codec import Instruction
from servobus.rig.local import open_rig
from servobus.values import Outcome
from tests.simulated_rigs import config, devices
from tests.virtual_time import virtual
from tests.wire_log import GOAL, TORQUE, WireLog, energised, frames

# Start


@virtual
async def test_start_asks_and_writes_nothing() -> None:
    wire = WireLog()
    async with open_rig(config(poll="{feedback: 50, health: 1}"), trace=wire) as rig:
        await asyncio.sleep(1)
        assert not any(energised(device) for device in devices(rig).values())
        assert rig.snapshot()["arm/s1"].position == 0
    assert wire.instructions() <= {Instruction.PING, Instruction.READ, Instruction.SYNC_READ}


@virtual
async def test_a_servo_missing_at_start_is_identified_later() -> None:
    async with open_rig(config(poll="{feedback: 50}")) as rig:
        devices(rig)[2].dead = True
        with pytest.raises(ReplyTimeout, match="arm/s2"):
            await rig.read("s2")
        for _ in range(5):
            with pytest.raises(ReplyTimeout):
                await rig.read("s2")
        devices(rig)[2].dead = False
        await asyncio.sleep(4)
        assert (await rig.read("s2")).health == "online"


# Enable and goals


@virtual
async def test_enable_takes_the_present_position_as_goal_before_torque() -> None:
    wire = WireLog()
    async with open_rig(config("s1: {id: 1, model: sts, zero: 2048}"), trace=wire) as rig:
        device = devices(rig)[1]
        device.joint.position = 1000.0
        wire.sent_frames.clear()
        await rig["s1"].enable()
        assert energised(device)
        assert device.get(GOAL) == 1000
        writes = [frame[5] for frame in wire.sent_frames if frame[4] == Instruction.WRITE]
        goal, torque = device.model.registers[GOAL].address, device.model.registers[TORQUE].address
        assert writes.index(goal) < writes.index(torque)


@virtual
async def test_a_goal_of_a_servo_that_is_not_enabled_costs_no_byte() -> None:
    async with open_rig(config()) as rig:
        before = frames(rig)
        with pytest.raises(NotEnabled, match="arm/s1"):
            await rig["s1"].move_to(1)
        assert frames(rig) == before


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, True, "1", None, 90.01, -90.01])
@virtual
async def test_a_goal_that_is_none_costs_no_byte(value: object) -> None:
    async with open_rig(config()) as rig:
        await rig.enable()
        before = frames(rig)
        with pytest.raises(LimitError, match="s1"):
            await rig["s1"].move_to(value)  # type: ignore[arg-type]
        with pytest.raises(LimitError):
            await rig.move({"s2": 1, "s1": value})  # type: ignore[dict-item]
        assert frames(rig) == before


@pytest.mark.parametrize("value", [90, -90, 0, 89.99])
@virtual
async def test_a_goal_on_the_limit_is_sent(value: float) -> None:
    async with open_rig(config()) as rig:
        await rig.enable()
        assert await rig["s1"].move_to(value) is Outcome.ACKED
        state = await rig["s1"].settle()
        assert state.position == pytest.approx(value, abs=0.9)


@virtual
async def test_clamp_sends_the_nearest_and_reports_it() -> None:
    async with open_rig(config("s1: {id: 1, model: sts, limits: [-10, 10], on_limit: clamp}")) as rig:
        await rig.enable()
        assert await rig["s1"].move_to(50) is Outcome.ACKED
        assert (await rig["s1"].settle()).position == pytest.approx(10, abs=0.9)
        assert rig.stats()["arm"]["goals_clamped"] == 1


@virtual
async def test_goals_of_one_moment_leave_in_one_frame() -> None:
    wire = WireLog()
    async with open_rig(config(), trace=wire) as rig:
        await rig.enable()
        wire.sent_frames.clear()
        outcomes = await asyncio.gather(*(servo.move_to(5) for servo in rig))
        assert outcomes == [Outcome.SENT] * 3
        assert [frame[4] for frame in wire.sent_frames if frame[4] != Instruction.SYNC_READ] == [Instruction.SYNC_WRITE]


@virtual
async def test_a_newer_goal_replaces_an_older_one() -> None:
    async with open_rig(config()) as rig:
        await rig.enable()
        first, second = await asyncio.gather(rig["s1"].move_to(5), rig["s1"].move_to(7))
        assert (first, second) == (Outcome.SUPERSEDED, Outcome.ACKED)
        assert (await rig["s1"].settle()).position == pytest.approx(7, abs=0.9)


@virtual
async def test_a_goal_that_is_too_old_is_dropped_with_an_error() -> None:
    async with open_rig(config()) as rig:
        await rig.enable()
        device = devices(rig)[1]
        before = device.get(GOAL)
        device.dead = True
        with pytest.raises(ReplyTimeout):
            await rig.read("s1")
        with pytest.raises(GoalExpired, match="s1"):
            await rig["s1"].move_to(5, start_within=0.05)
        device.dead = False
        await asyncio.sleep(5)
        assert device.get(GOAL) == before


@virtual
async def test_one_failure_among_several_is_a_partial_failure() -> None:
    async with open_rig(config()) as rig:
        await rig.enable()
        devices(rig)[2].dead = True
        with pytest.raises(ReplyTimeout):
            await rig.read("s2")
        with pytest.raises(PartialFailure) as caught:
            await rig.move({"s1": 3, "s2": 3})
        assert caught.value.results["arm/s1"] is Outcome.ACKED
        assert isinstance(caught.value.results["arm/s2"], GoalExpired)


@virtual
async def test_together_and_confirm_withholds_action_when_one_is_silent() -> None:
    async with open_rig(config()) as rig:
        await rig.enable()
        devices(rig)[2].dead = True
        with pytest.raises(PartialFailure):
            await rig.move({"s1": 9, "s2": 9}, together=True, confirm=True)
        await asyncio.sleep(1)
        assert (await rig.read("s1")).position == 0


@virtual
async def test_wheel_mode_spins_and_stops() -> None:
    async with open_rig(config("w: {id: 1, model: sts}")) as rig:
        device = devices(rig)[1]
        device.memory.store(device.memory.registers["mode"], 1)
        await rig.identify("w")
        with pytest.raises(NotEnabled):
            await rig["w"].spin(90)
        await rig.enable()
        assert await rig["w"].spin(90) is Outcome.ACKED
        await asyncio.sleep(0.5)
        assert (await rig.read("w")).speed == pytest.approx(90, abs=1)
        with pytest.raises(NotSupported, match="velocity"):
            await rig["w"].move_to(0)
        await rig.stop()
        await asyncio.sleep(0.1)
        assert (await rig.read("w")).speed == 0


# Exit


@pytest.mark.parametrize(("policy", "on"), [("hold", True), ("limp", False)])
@virtual
async def test_the_end_leaves_each_servo_as_its_policy_says(policy: str, on: bool) -> None:
    async with open_rig(config(f"s1: {{id: 1, model: sts, on_exit: {policy}}}", "s2: {id: 2, model: sts}")) as rig:
        await rig.enable("s1")
        servos = devices(rig)
    assert energised(servos[1]) is on
    assert not energised(servos[2])


@virtual
async def test_the_end_reaches_a_servo_whose_enable_nobody_waited_for() -> None:
    loop, torque_on = asyncio.get_running_loop(), asyncio.Event()

    def trace(bus: str, sent: bool, data: bytes, time: float) -> None:
        if sent and data[4:] == bytes((Instruction.WRITE, 0x28, 1)) + data[-1:]:
            torque_on.set()

    async with open_rig(config("s1: {id: 1, model: sts, on_exit: limp}", "s2: {id: 2, model: sts}"), trace=trace) as rig:
        device = devices(rig)[1]
        enabling = loop.create_task(rig.enable("s1"))
        await torque_on.wait()
        enabling.cancel()
    assert not energised(device)
    assert {name: (report.action, report.confirmed) for name, report in rig.left.items()} == {"arm/s1": ("limp", True)}


@virtual
async def test_what_was_disabled_or_parked_is_not_left_a_second_time() -> None:
    async with open_rig(config("s1: {id: 1, model: sts}", "s2: {id: 2, model: sts, on_exit: park, park_pose: 3}")) as rig:
        await rig.enable()
        await rig.disable("s1")
        device = devices(rig)[2]
    assert not energised(device)
    assert {name: (report.action, report.confirmed) for name, report in rig.left.items()} == {"arm/s2": ("park", True)}


@virtual
async def test_the_end_parks() -> None:
    async with open_rig(config("s1: {id: 1, model: sts, on_exit: park, park_pose: 30}")) as rig:
        await rig.enable()
        device = devices(rig)[1]
    assert device.joint.position == pytest.approx(2048 + 30 / 360 * 4096, abs=10)
    assert not energised(device)


@virtual
async def test_an_error_in_the_block_is_raised_after_the_exit_policy() -> None:
    with pytest.raises(ZeroDivisionError):  # noqa: PT012 - it is raised by the last statement
        async with open_rig(config("s1: {id: 1, model: sts, on_exit: limp}")) as rig:
            await rig.enable()
            device = devices(rig)[1]
            raise ZeroDivisionError
    assert not energised(device)
