"""What moves on one bus, where the rig's tests cannot reach: callers that leave, servos that fail while they are
enabled or parked.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import pytest

from servobus.errors import Busy, DeviceError, EStopped, LinkDown, NotEnabled, ReplyTimeout
from servobus.protocols.sms.codec import Instruction, encode
from servobus.values import Goal, Outcome, ServoGoal
from tests.engine.scripted_line import Answers, Puppet, puppet_bus, table_of
from tests.virtual_time import virtual

PARKED = "s1: {id: 1, model: sts, on_estop: park, park_pose: 10, park_timeout: 0.5}"


@virtual
async def test_a_caller_who_leaves_takes_its_goal_along() -> None:
    async with puppet_bus() as (bus, puppet, _, _):
        bus.records["s1"].enabled = True
        futures = bus.motion.put(bus.motion.check({"s1": Goal("position", 5)}), together=False, confirm=False)
        futures["s1"].cancel()
        await asyncio.sleep(0.1)
        assert puppet.frames == []
        assert len(bus.scheduler.goals.coalescer) == 0


@virtual
async def test_a_checked_goal_brings_the_bytes_that_are_sent() -> None:
    async with puppet_bus() as (bus, _, _, _):
        bus.records["s1"].enabled = True
        checked = bus.motion.check({"s1": Goal("position", 5)})["s1"]
        assert checked.packed.is_for(checked)
        assert await bus.motion.send("s1", checked.goal, confirm=False) is Outcome.ACKED


def keeping(puppet: Puppet) -> Callable[[bytes], Answers | None]:
    """A servo that keeps what is written; its torque is off at first."""
    puppet.tables = {node: table_of(node, torque_enable=0) for node in (1, 2)}

    def script(frame: bytes) -> Answers | None:
        if frame[4] == Instruction.WRITE:
            puppet.tables[frame[2]].write(frame[5], frame[6:-1])
        return None

    return script


@virtual
async def test_enable_identifies_the_servo_first() -> None:
    async with puppet_bus(started=False) as (bus, puppet, _, _):
        puppet.script = keeping(puppet)
        await bus.motion.enable("s1")
        assert bus.records["s1"].enabled
        identity = bus.records["s1"].identity
        assert identity is not None
        assert puppet.frames[1][4:6] == bytes((Instruction.READ, 0)), "behind the fence comes the question who it is"


@virtual
async def test_an_e_stop_in_the_moment_in_which_enable_succeeds_wins() -> None:
    async with puppet_bus() as (bus, puppet, _, _):
        keep = keeping(puppet)

        def script(frame: bytes) -> Answers | None:
            keep(frame)
            if frame[4] == Instruction.READ and puppet.tables[1].data[40]:
                bus.stops.latched = True  # the last answer is on its way
            return None

        puppet.script = script
        with pytest.raises(EStopped, match="while the servo was being enabled"):
            await bus.motion.enable("s1")
        assert not bus.records["s1"].enabled


@virtual
async def test_a_servo_that_does_not_take_its_goal_stays_disabled() -> None:
    async with puppet_bus() as (bus, puppet, _, _):
        puppet.tables[1] = table_of(1, torque_enable=0)  # whatever is written
        with pytest.raises(DeviceError, match="arm/s1"):
            await bus.motion.enable("s1")
        assert not bus.records["s1"].enabled


@virtual
async def test_disable_that_does_not_read_back_is_an_error_and_it_is_disabled_for_us() -> None:
    async with puppet_bus() as (bus, puppet, _, _):
        bus.records["s1"].enabled = True
        torque = encode(1, Instruction.READ, bytes((40, 1)))
        puppet.script = lambda frame: [(0.001, encode(1, 0, b"\x01"))] if frame == torque else None
        with pytest.raises(DeviceError, match="not confirmed"):
            await bus.motion.disable("s1")
        assert not bus.records["s1"].enabled


@virtual
async def test_disable_is_refused_in_an_exclusive_session() -> None:
    async with puppet_bus() as (bus, puppet, _, _), bus.exclusive():
        puppet.frames.clear()
        with pytest.raises(Busy, match="arm/s1"):
            await bus.motion.disable("s1")
        assert puppet.frames == []


@virtual
@pytest.mark.parametrize("how", ["disabled", "restarted"])
async def test_settle_fails_when_the_servo_is_disabled_or_restarts(how: str) -> None:
    async with puppet_bus() as (bus, puppet, _, _):
        puppet.script = keeping(puppet)
        await bus.motion.enable("s1")
        bus.records["s1"].goal = 50.0
        settling = asyncio.create_task(bus.motion.settle("s1", tolerance=None, timeout=5))
        await asyncio.sleep(0.1)
        assert not settling.done()
        if how == "disabled":
            await bus.motion.disable("s1")
        else:
            puppet.script = lambda frame: None
            puppet.tables[1].restart()
            bus.nodes.suspect_all()
        with pytest.raises(NotEnabled, match=r"arm/s1.*before it arrived at its goal"):
            await settling


@virtual
async def test_a_stop_while_the_position_is_read_is_not_taken_for_arrival() -> None:
    """The hold puts the setpoint where it stands; a read that was under way then would find it there."""
    async with puppet_bus() as (bus, puppet, _, _):
        keep, asked = keeping(puppet), asyncio.Event()
        puppet.script = keep
        await bus.motion.enable("s1")
        bus.records["s1"].goal = 50.0

        def script(frame: bytes) -> Answers | None:
            asked.set()
            return keep(frame)

        puppet.script = script
        settling = asyncio.create_task(bus.motion.settle("s1", tolerance=None, timeout=5))
        await asked.wait()
        await bus.stops.stop()
        with pytest.raises(EStopped, match="before the servo arrived at its goal"):
            await settling


@virtual
async def test_disable_ends_a_goal_that_waits() -> None:
    async with puppet_bus() as (bus, puppet, _, _):
        bus.records["s1"].enabled = True
        puppet.script = lambda frame: [] if frame[2] == 1 else None
        with pytest.raises(ReplyTimeout):
            await bus.read_register("s1", "id")
        future = bus.motion.put({"s1": ServoGoal("s1", Goal("position", 5))}, together=False, confirm=False)["s1"]
        with pytest.raises(ReplyTimeout):
            await bus.motion.disable("s1")
        with pytest.raises(NotEnabled, match="arm/s1"):
            await future


@virtual
async def test_a_goal_on_a_line_that_is_down_fails_at_once() -> None:
    async with puppet_bus() as (bus, _, link, _):
        bus.records["s1"].enabled = True
        link.unplug()
        await asyncio.sleep(0)
        with pytest.raises(LinkDown, match="arm/s1"):
            await bus.motion.put({"s1": ServoGoal("s1", Goal("position", 5))}, together=False, confirm=False)["s1"]


@virtual
async def test_the_e_stop_ends_an_enable_under_way() -> None:
    async with puppet_bus() as (bus, puppet, _, _):
        enabling = asyncio.create_task(bus.motion.enable("s1"))
        await asyncio.sleep(0.0025)
        await bus.stops.stop()
        with pytest.raises(EStopped):
            await enabling
        assert not bus.records["s1"].enabled
        assert not any(frame[4] == Instruction.WRITE and frame[5] == 40 and frame[6] == 1 for frame in puppet.frames)


@virtual
async def test_a_servo_that_does_not_arrive_at_its_park_pose_goes_limp() -> None:
    async with puppet_bus(PARKED) as (bus, puppet, _, _):
        puppet.script = keeping(puppet)
        await bus.motion.enable("s1")
        report = await bus.motion.park("s1")
        assert (report.action, report.written, report.confirmed) == ("park", True, False)
        assert "park pose" in report.detail
        assert not bus.records["s1"].enabled
        assert any(frame[4] == Instruction.SYNC_WRITE and frame[5] == 40 for frame in puppet.frames)


@virtual
async def test_a_bus_without_servos_stops_too() -> None:
    async with puppet_bus() as (bus, puppet, _, _):
        bus.records.clear()
        assert await bus.stops.stop() == {}
        assert puppet.frames == []


@virtual
async def test_one_outcome_for_each_goal_of_a_frame() -> None:
    async with puppet_bus() as (bus, puppet, _, _):
        for record in bus.records.values():
            record.enabled = True
        goals = bus.motion.check({"s1": Goal("position", 5), "s2": Goal("position", -5)})
        futures = bus.motion.put(goals, together=True, confirm=False)
        assert await asyncio.gather(*futures.values()) == [Outcome.SENT, Outcome.SENT]
        assert len(puppet.frames) == 1
        assert bus.records["s1"].setpoint == bus.records["s1"].goal == 5
