"""Ramps seen from the wire: what was sent, and where the joint was at that moment. In virtual time."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable

import pytest

from servobus.bus.service import BusService
from servobus.errors import DeviceError, ServobusError
from servobus.protocols.kst.codec import Command, decode_position
from servobus.protocols.kst.simulated.device import KstDevice
from servobus.values import Goal, Health
from tests.protocols.kst.test_bus import running
from tests.virtual_time import virtual

STEP = 12
"""Steps of a setpoint at 60 deg/s and 50 Hz."""
POLLS: dict[str, dict[str, float]] = {"polled": {"feedback": 50, "health": 1}, "health only": {"health": 1}, "no polls": {}}
BY_POLLS = pytest.mark.parametrize("poll", POLLS.values(), ids=list(POLLS))


class Joint:
    """The wire of one servo: each position that it was sent, and how far that was from where it was."""

    def __init__(self, bus: BusService, device: KstDevice) -> None:
        self.device = device
        self.sent: list[int] = []
        self.leaps: list[float] = []
        bus.master.trace = self._trace

    def _trace(self, sent: bool, data: bytes, now: float) -> None:
        if sent and data[2] == self.device.node and data[3] == Command.SET_POSITION:
            self.device.advance(now)
            self.sent.append(decode_position(data[4:]))
            self.leaps.append(abs(self.sent[-1] - self.device.position))


async def go(bus: BusService, target: float) -> ServobusError:
    """Send a goal to pan; the error that it ends with."""
    try:
        await bus.motion.send("pan", Goal("position", target), confirm=False)
    except ServobusError as error:
        return error
    raise AssertionError("it was sent")


@BY_POLLS
def test_a_servo_that_is_not_heard_is_not_run_away_from(poll: dict[str, float]) -> None:
    """Setpoints that do not arrive are not superseded by the next: heard again, the servo has one step to go."""

    @virtual
    async def run() -> None:
        for silence in (0.03, 0.1, 0.2, 0.4, 0.6, 1.0, 2.0):
            async with running(poll=poll) as (bus, servos, _):
                joint = Joint(bus, servos[0])
                await bus.motion.enable("pan")
                await bus.motion.send("pan", Goal("position", 80.0), confirm=False)
                await asyncio.sleep(0.3)
                servos[0].dead = True
                await asyncio.sleep(silence)
                servos[0].dead = False
                await asyncio.sleep(3)
                assert max(joint.leaps) <= STEP + 1, silence

    run()


@BY_POLLS
@pytest.mark.parametrize("fault", ["dead", "mute"])
def test_a_servo_that_goes_offline_ends_its_ramp_and_stands_still(poll: dict[str, float], fault: str) -> None:
    @virtual
    async def run() -> None:
        async with running(poll=poll) as (bus, servos, events):
            joint = Joint(bus, servos[0])
            await bus.motion.enable("pan")
            await bus.motion.send("pan", Goal("position", 80.0), confirm=False)
            await asyncio.sleep(0.3)
            setattr(servos[0], fault, True)
            await asyncio.sleep(2)
            setattr(servos[0], fault, False)
            servos[0].advance(bus.clock())
            stood, sent = servos[0].position, len(joint.sent)
            await asyncio.sleep(3)
            assert bus.state("pan").health is Health.ONLINE
            assert "motion_cut" in events
            assert (servos[0].position, len(joint.sent)) == (stood, sent)
            assert 160 < stood < 240, "where it was 0.3 s after the start, at 60 deg/s"

    run()


@BY_POLLS
def test_a_servo_that_lags_is_sent_at_most_one_step_ahead(poll: dict[str, float]) -> None:
    @virtual
    async def run() -> None:
        for speed in (50.0, 200.0, 550.0):
            async with running(poll=poll) as (bus, servos, _):
                servos[0].speed = speed
                joint = Joint(bus, servos[0])
                await bus.motion.enable("pan")
                await bus.motion.send("pan", Goal("position", 20.0), confirm=False)
                await bus.motion.settle("pan", tolerance=0.1, timeout=10)
                assert joint.sent[-1] == 200
                assert max(joint.leaps) <= STEP + 1

    run()


@virtual
async def test_a_blocked_servo_is_pushed_by_one_step_and_goes_on_when_it_is_free() -> None:
    async with running() as (bus, servos, _):
        joint = Joint(bus, servos[0])
        servos[0].room = (-900.0, 100.0)
        await bus.motion.enable("pan")
        await bus.motion.send("pan", Goal("position", 40.0), confirm=False)
        await asyncio.sleep(3)
        assert servos[0].goal <= 100 + STEP
        servos[0].room = (-900.0, 900.0)
        await bus.motion.settle("pan", tolerance=0, timeout=5)
        assert max(joint.leaps) <= STEP + 1


@virtual
async def test_the_speed_is_kept_while_the_servo_follows() -> None:
    async with running(goal_rate=50, poll={}) as (bus, _, _):
        await bus.motion.enable("pan")
        began = bus.clock()
        await bus.motion.send("pan", Goal("position", 60.0, speed=30.0), confirm=False)
        await bus.motion.settle("pan", tolerance=0, timeout=5)
        assert bus.clock() - began == pytest.approx(2.0, abs=0.1)


@pytest.mark.slow
@BY_POLLS
def test_a_goal_after_a_restart_is_refused(poll: dict[str, float]) -> None:
    """0 to 2 s off, at any moment, whether a question fell into it or not. KST RS422, 3.5: then it is at its default position."""

    @virtual
    async def run() -> None:
        random_source = random.Random(7)
        for _ in range(25):
            async with running(poll=poll) as (bus, servos, events):
                await bus.motion.enable("pan")
                await bus.motion.send("pan", Goal("position", 60.0), confirm=False)
                await bus.motion.settle("pan", tolerance=0, timeout=5)
                await asyncio.sleep(random_source.uniform(0, 1))
                joint = Joint(bus, servos[0])
                await off_and_on(servos[0], random_source.uniform(0, 2), bus.clock)
                await asyncio.sleep(random_source.choice((0.2, 1.0, 3.0)))
                await go(bus, 70.0)
                await asyncio.sleep(5)
                await go(bus, 70.0)
                assert joint.sent == []
                assert "servo_restarted" in events
                assert not bus.state("pan").enabled

    run()


async def off_and_on(device: KstDevice, seconds: float, clock: Callable[[], float]) -> None:
    """Switch it off; when it is on again it goes to its default position, so fast that it is soon there."""
    device.reboot(clock())
    device.dead = True
    await asyncio.sleep(seconds)
    device.dead = False


@BY_POLLS
def test_a_stop_is_not_confirmed_while_the_servo_moves(poll: dict[str, float]) -> None:
    """An acknowledgement is no effect: the servo repeats what it was sent, and travels on."""

    @virtual
    async def run() -> None:
        async with running(poll=poll) as (bus, servos, _):
            await bus.motion.enable("pan")
            await bus.motion.send("pan", Goal("position", 10.0), confirm=False)
            await asyncio.sleep(0.05)
            servos[0].goal, servos[0].speed, servos[0].ignores_goals = 800.0, 100.0, True
            reports = await bus.stops.stop()
            assert (reports["pan"].written, reports["pan"].confirmed, reports["tilt"].confirmed) == (True, False, True)
            assert "it still moves" in reports["pan"].detail

    run()


@BY_POLLS
@pytest.mark.parametrize("fault", ["dead", "mute"])
def test_a_stop_reaches_a_servo_that_is_heard_later(poll: dict[str, float], fault: str) -> None:
    @virtual
    async def run() -> None:
        async with running(poll=poll) as (bus, servos, events):
            joint = Joint(bus, servos[0])
            await bus.motion.enable("pan")
            await bus.motion.send("pan", Goal("position", 80.0), confirm=False)
            await asyncio.sleep(0.3)
            setattr(servos[0], fault, True)
            assert not (await bus.stops.stop())["pan"].confirmed
            await asyncio.sleep(0.6)
            setattr(servos[0], fault, False)
            await asyncio.sleep(1)
            assert events.count("stop_owed") == events.count("stop_paid") == 1
            assert joint.leaps[-1] <= STEP + 1
            assert not bus.stops.owed

    run()


@virtual
async def test_settle_tells_why_a_motion_was_cut() -> None:
    async with running() as (bus, servos, events):
        await bus.motion.enable("pan")
        await bus.motion.send("pan", Goal("position", 80.0), confirm=False)
        await asyncio.sleep(0.2)
        servos[0].refuses[Command.SET_POSITION] = 0x06090030
        with pytest.raises(DeviceError, match="0609 0030"):
            await bus.motion.settle("pan", tolerance=None, timeout=10)
        assert events.count("motion_cut") == 1
        del servos[0].refuses[Command.SET_POSITION]
        await bus.motion.send("pan", Goal("position", 20.0), confirm=False)
        assert (await bus.motion.settle("pan", tolerance=0, timeout=10)).position == 20


@BY_POLLS
def test_a_servo_that_does_not_say_whether_it_moves_has_settled_when_it_rests(poll: dict[str, float]) -> None:
    """A short way is inside the tolerance from the beginning."""

    @virtual
    async def run() -> None:
        async with running(poll=poll) as (bus, _, _):
            await bus.motion.enable("pan")
            await bus.motion.send("pan", Goal("position", 1.0), confirm=False)
            assert (await bus.motion.settle("pan", tolerance=None, timeout=5)).position == 1

    run()


@virtual
async def test_a_poll_without_the_position_makes_no_position_fresh() -> None:
    async with running(poll={"health": 50}) as (bus, servos, _):
        servos[0].goal = 300
        await asyncio.sleep(1)
        age = bus.state("pan").age
        assert age is not None
        assert age > 0.5
        assert (await bus.read("pan", max_age=0.2)).position == 30


@virtual
async def test_a_stream_of_goals_keeps_the_speed_and_leads_by_one_step() -> None:
    """Four goals in each cycle, of which each would be a step."""
    async with running(poll={"feedback": 50}) as (bus, servos, _):
        joint = Joint(bus, servos[0])
        await bus.motion.enable("pan")
        began = bus.clock()
        while bus.clock() < began + 1.0:
            bus.motion.send("pan", Goal("position", 80.0, speed=30.0), confirm=False)
            await asyncio.sleep(0.005)
        servos[0].advance(bus.clock())
        assert servos[0].position == pytest.approx(300, abs=12)
        assert max(joint.leaps) <= STEP // 2 + 1
