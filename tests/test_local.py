"""The rig as its users know it, on simulated servos in virtual time: what is refused, what is sent, what is left behind."""

from __future__ import annotations

import asyncio
import math

import pytest

from servobus.errors import (
    DeviceError,
    EStopped,
    GoalExpired,
    LeaseHeld,
    LimitError,
    LinkDown,
    NotEnabled,
    NotSupported,
    PartialFailure,
    PortMissing,
    ReplyTimeout,
    UnknownName,
)
from servobus.local import LocalRig
from servobus.opening import open_rig
from servobus.protocols.sms.codec import Instruction
from servobus.protocols.sms.device import SmsDevice
from servobus.protocols.words import Goal, Outcome
from tests.rigs import config, devices
from tests.virtual import virtual

TORQUE, GOAL = "torque_enable", "goal_position"


class Wire:
    """Keeps the frames that were said."""

    def __init__(self) -> None:
        self.said: list[bytes] = []

    def __call__(self, bus: str, sent: bool, data: bytes, time: float) -> None:
        if sent:
            self.said.append(data)

    def instructions(self) -> set[Instruction]:
        return {Instruction(frame[4]) for frame in self.said}


def frames(rig: LocalRig, bus: str = "arm") -> int:
    """How many frames were said so far."""
    return int(rig.stats()[bus]["frames"])


def energised(device: SmsDevice) -> bool:
    return device.get(TORQUE) == 1


# Start


@virtual
async def test_start_asks_and_writes_nothing() -> None:
    wire = Wire()
    async with open_rig(config(poll="{feedback: 50, health: 1}"), trace=wire) as rig:
        await asyncio.sleep(1)
        assert not any(energised(device) for device in devices(rig).values())
        assert rig.snapshot()["arm/s1"].position == 0
    assert wire.instructions() <= {Instruction.PING, Instruction.READ, Instruction.SYNC_READ}


@virtual
async def test_a_missing_servo_is_no_error_at_start_and_is_found_when_it_comes() -> None:
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
    wire = Wire()
    async with open_rig(config("s1: {id: 1, model: sts, zero: 2048}"), trace=wire) as rig:
        device = devices(rig)[1]
        device.joint.position = 1000.0
        wire.said.clear()
        await rig["s1"].enable()
        assert energised(device)
        assert device.get(GOAL) == 1000
        writes = [frame[5] for frame in wire.said if frame[4] == Instruction.WRITE]
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
    wire = Wire()
    async with open_rig(config(), trace=wire) as rig:
        await rig.enable()
        wire.said.clear()
        outcomes = await asyncio.gather(*(servo.move_to(5) for servo in rig))
        assert outcomes == [Outcome.SENT] * 3
        assert [frame[4] for frame in wire.said] == [Instruction.SYNC_WRITE]


@virtual
async def test_a_newer_goal_takes_the_place_of_an_older_one() -> None:
    async with open_rig(config()) as rig:
        await rig.enable()
        first, second = await asyncio.gather(rig["s1"].move_to(5), rig["s1"].move_to(7))
        assert (first, second) == (Outcome.SUPERSEDED, Outcome.ACKED)
        assert (await rig["s1"].settle()).position == pytest.approx(7, abs=0.9)


@virtual
async def test_a_goal_too_old_is_dropped_and_said_so() -> None:
    async with open_rig(config()) as rig:
        await rig.enable()
        device = devices(rig)[1]
        before = device.get(GOAL)
        device.dead = True
        with pytest.raises(ReplyTimeout):
            await rig.read("s1")
        with pytest.raises(GoalExpired, match="s1"):
            await rig["s1"].move_to(5, deadline=0.05)
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
        with pytest.raises(EStopped, match="park"):
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


# Exit


@pytest.mark.parametrize(("policy", "on"), [("hold", True), ("limp", False)])
@virtual
async def test_the_end_leaves_each_servo_as_its_policy_says(policy: str, on: bool) -> None:
    async with open_rig(config(f"s1: {{id: 1, model: sts, on_exit: {policy}}}", "s2: {id: 2, model: sts}")) as rig:
        await rig.enable("s1")
        known = devices(rig)
    assert energised(known[1]) is on
    assert not energised(known[2])


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
async def test_an_error_in_the_body_comes_out_as_it_is_and_the_policy_is_applied() -> None:
    with pytest.raises(ZeroDivisionError):  # noqa: PT012 - it is raised by the last statement
        async with open_rig(config("s1: {id: 1, model: sts, on_exit: limp}")) as rig:
            await rig.enable()
            device = devices(rig)[1]
            raise ZeroDivisionError
    assert not energised(device)


# Restart and plug


@virtual
async def test_a_restarted_servo_is_disabled_and_its_goal_is_not_said_again() -> None:
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
    wire = Wire()
    async with open_rig(config(poll="{feedback: 50}"), trace=wire) as rig:
        await rig.enable()
        link = rig.keepers["arm"].link
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
        wire.said.clear()
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
async def test_read_answers_from_the_last_poll_when_that_is_fresh_enough() -> None:
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
        seen = []
        async for snapshot in rig.watch(hz=20):
            seen.append(snapshot)
            if len(seen) == 3:
                break
        assert all(set(snapshot) == {"arm/s1", "arm/s2", "arm/s3"} for snapshot in seen)
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
        with pytest.raises(DeviceError, match="0"):
            await rig["s1"].settle(timeout=0.5)


@virtual
async def test_scan_finds_and_refuses_while_something_is_enabled() -> None:
    async with open_rig(config()) as rig:
        progress: list[int] = []
        found = await rig.scan("arm", ids=range(4), progress=lambda asked, count, hit: progress.append(asked))
        assert [(hit.id, hit.model) for hit in found] == [(1, "sts"), (2, "sts"), (3, "sts")]
        assert progress[-1] == 4
        await rig.enable("s1")
        with pytest.raises(LeaseHeld, match="s1"):
            await rig.scan("arm", ids=[1])
        with pytest.raises(UnknownName):
            await rig.scan("leg")


@virtual
async def test_scan_over_baud_rates_comes_back_to_the_own_one() -> None:
    async with open_rig(config()) as rig:
        device = devices(rig)[2]
        device.baudrate = 115200
        found = await rig.scan("arm", baudrates=[115200, 1000000], ids=range(4))
        assert [(hit.id, hit.baudrate) for hit in found] == [(2, 115200), (1, 1000000), (3, 1000000)]
        assert (await rig.read("s1")).position == 0


@virtual
async def test_a_goal_with_everything_said() -> None:
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
