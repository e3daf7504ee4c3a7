"""Restarts of hands, at any moment: no goal follows one. Direct and behind an arm, with and without polls, in virtual time."""

from __future__ import annotations

import asyncio
import random

import pytest

from servobus.bus.service import BusService
from servobus.errors import DeviceError, ReplyTimeout, ServobusError
from servobus.protocols.roh.model import packaged_models
from servobus.protocols.roh.simulated.device import RohDevice
from servobus.values import Goal, Health, Loss
from tests.protocols.roh.bench import HAND, Bench, bench_of, goal
from tests.protocols.roh.test_bus import TWO, running
from tests.virtual_time import virtual

MAPS = pytest.mark.parametrize("name", ["legacy", "v1", "v2"])
POLLS: dict[str, dict[str, float]] = {"polled": {"feedback": 20, "health": 5}, "health only": {"health": 1}, "no polls": {}}
BY_POLLS = pytest.mark.parametrize("poll", POLLS.values(), ids=list(POLLS))
BY_LINK = pytest.mark.parametrize("behind_arm", [False, True], ids=["direct", "behind an arm"])
BY_SELF_TEST = pytest.mark.parametrize("self_test", [0, 1], ids=["no self-test", "self-test"])

pytestmark = pytest.mark.slow


def targets_written(hand: RohDevice) -> list[tuple[int, int]]:
    """Return the writes of targets, by the map of the hand."""
    first = hand.model.named("pos_target").address
    return [(address, word) for address, word in hand.written if first <= address < first + 6]


async def go(bus: BusService, servo: str, target: float) -> ServobusError | None:
    """Send a goal; the error that it ends with."""
    try:
        await bus.motion.send(servo, Goal("position", target), confirm=False)
    except ServobusError as error:
        return error
    return None


async def off_and_on(hand: RohDevice, seconds: float, now: float) -> None:
    hand.reboot(now)
    hand.dead = True
    await asyncio.sleep(seconds)
    hand.dead = False
    hand._awake = asyncio.get_running_loop().time() + 0.05
    if hand.state == "init":
        hand._ready = hand._awake + 0.3


@BY_POLLS
@BY_LINK
@BY_SELF_TEST
def test_no_goal_follows_a_restart(poll: dict[str, float], behind_arm: bool, self_test: int) -> None:
    """0 to 2 s off, whether a question fell into it or not; also of fingers whose target is what it is after a restart."""

    @virtual
    async def run() -> None:
        source = random.Random(self_test)
        for number in range(12):
            async with running(TWO, poll=poll, behind_arm=behind_arm) as (bus, hands, events):
                hands[0].poke("self_test", 0, self_test)
                for name in TWO:
                    await bus.motion.enable(name)
                if number % 2:
                    assert await go(bus, "a", 60) is None
                    await bus.motion.settle("a", tolerance=1, timeout=5)
                await asyncio.sleep(source.uniform(0, 1))
                hands[0].written.clear()
                await off_and_on(hands[0], source.uniform(0, 2), bus.clock())
                await asyncio.sleep(source.choice((0.0, 0.1, 0.5, 3.0)))
                assert await go(bus, "a", 70) is not None
                await asyncio.sleep(4)
                assert await go(bus, "a", 70) is not None
                assert await go(bus, "b", 70) is not None
                assert targets_written(hands[0]) == []
                assert events.count("servo_restarted") == 2
                assert [bus.state(name).enabled for name in TWO] == [False, False, True]
                assert await go(bus, "c", 20) is None, "the other hand goes on"

    run()


@BY_LINK
@virtual
async def test_a_hand_that_is_off_goes_offline(behind_arm: bool) -> None:
    """An arm reports its silence as an exception (0x0B), which says nothing about the hand."""
    async with running(TWO, behind_arm=behind_arm) as (bus, hands, _):
        hands[0].dead = True
        await asyncio.sleep(2)
        assert (bus.state("a").health, bus.state("c").health) == (Health.OFFLINE, Health.ONLINE)
        with pytest.raises(ReplyTimeout):
            await bus.read("a")
        hands[0].dead = False
        await asyncio.sleep(5)
        assert bus.state("a").health is Health.ONLINE


# The registers that show it


@MAPS
def test_a_restart_shows_in_the_speed_of_each_enabled_finger(name: str) -> None:
    """A hand starts with 65535, so that is never written; the target alone may be what it is after a restart."""
    bench = bench_of(name)
    bench.enable("index")
    assert bench.read("index", "speed", raw=True) == 65534
    assert verify(bench, "index") == {}
    bench.move(goal("index", 0, speed=100))
    assert bench.read("index", "speed", raw=True) == 65534
    bench.hand.reboot(bench.now)
    bench.after(5)
    assert bench.read("index", "goal_position", raw=True) == 0
    assert verify(bench, "index") == {"index": Loss.RESTARTED}


@MAPS
def test_a_verification_is_one_read_of_a_hand(name: str) -> None:
    bench = bench_of(name).enable()
    assert verify(bench, *bench.driver.nodes) == {}
    assert len(bench.frames()) == 1


def test_a_hand_that_does_not_answer_or_refuses_shows_nothing() -> None:
    bench = Bench().enable("index")
    bench.hand.dead = True
    assert verify(bench, "index") == {}
    bench.hand.dead = False
    bench.hand.max_registers = 0
    assert verify(bench, "index") == {}
    bench.hand.max_registers = 125
    bench.hand.refuses_reads_while_busy, bench.hand.state, bench.hand._ready = True, "init", 99.0
    assert verify(bench, "index") == {"index": Loss.RESTARTED}, "it initialises"


def test_a_hand_that_rounds_what_is_written_shows_no_restart() -> None:
    """Whether it does is not documented."""
    bench = Bench().enable("index")
    bench.move(goal("index", 50, speed=50))
    bench.hand.poke("speed", 1, 32700)
    bench.hand.fingers[1].target = 32700
    assert verify(bench, "index") == {}
    assert bench.run(bench.driver.fence(2, [], ["index"]))


def test_a_speed_of_a_user_is_no_restart() -> None:
    bench = Bench().enable("index")
    bench.write("index", "speed", 65535, raw=True)
    assert bench.read("index", "speed", raw=True) == 65534
    bench.write("index", "speed", 50)
    assert verify(bench, "index") == {}


def test_what_a_read_brings_tells_a_restart() -> None:
    bench = Bench().enable("index")
    assert bench.exchange(bench.driver.read_state("index"))["index"]["loss"] is None
    assert "loss" not in bench.exchange(bench.driver.read_state("ring"))["ring"], "it was not enabled"
    bench.hand.reboot(bench.now)
    bench.after(5)
    assert bench.exchange(bench.driver.read_state("index"))["index"]["loss"] is Loss.RESTARTED


def verify(bench: Bench, *servos: str) -> dict[str, Loss]:
    bench.frames()
    plan = bench.driver.verify(servos)
    assert plan is not None
    return dict(bench.run(plan))


def test_an_angle_that_the_hand_replaced_by_its_own_limit_is_no_restart() -> None:
    """Angle ranges differ from hand to hand; a target outside is silently replaced (the vendor's FAQ)."""
    bench = Bench({"index": {**HAND["index"], "unit": "deg"}}).enable()
    bench.move(goal("index", 102))
    bench.hand.poke("angle_target", 1, 10800)
    assert verify(bench, "index") == {}
    assert bench.run(bench.driver.fence(2, [], ["index"]))
    bench.hand.reboot(bench.now)
    assert verify(bench.after(5), "index") == {"index": Loss.RESTARTED}


@MAPS
def test_a_restart_shows_whatever_speed_a_hand_starts_with(name: str) -> None:
    bench = Bench({"index": {**HAND["index"], "speed": 40}}, maps={2: name})
    bench.hand.poke("speed", 1, 0)
    bench.enable("index")
    assert bench.read("index", "speed", raw=True) == 26214
    bench.hand.poke("speed", 1, 0)
    assert verify(bench, "index") == {"index": Loss.RESTARTED}


# Enable


@MAPS
def test_enable_moves_no_finger(name: str) -> None:
    bench = bench_of(name)
    finger = bench.hand.fingers[1]
    finger.position, finger.target = 30000.0, 30000
    assert bench.run(bench.driver.enable("index")) == pytest.approx(30000 / 655.35)
    assert targets_written(bench.hand) == []
    assert bench.after(5).hand.fingers[1].position == 30000


def test_a_finger_whose_target_is_elsewhere_stays_where_it_is() -> None:
    """Its speed was 0, or so low that it seems to rest: the first goal would give it another."""
    bench = Bench()
    finger = bench.hand.fingers[1]
    finger.position, finger.target = 30000.0, 65535
    bench.hand.poke("speed", 1, 0)
    finger.speed = 0
    bench.run(bench.driver.enable("index"))
    assert targets_written(bench.hand) == [(1136, 30000)]
    bench.hand.written.clear()
    bench.move(goal("index", 50))
    assert bench.after(0.0001).hand.fingers[1].position < 33000


def test_a_finger_that_holds_something_keeps_its_target() -> None:
    bench = Bench()
    finger = bench.hand.fingers[1]
    finger.position, finger.target, finger.obstacle = 30000.0, 65535, 30000.0
    bench.after(0).after(2)
    bench.run(bench.driver.enable("index"))
    assert targets_written(bench.hand) == []


def test_a_finger_that_moves_is_not_enabled() -> None:
    bench = Bench()
    bench.hand.fingers[1].target, bench.hand.fingers[1].speed = 65535, 10000
    with pytest.raises(DeviceError, match=r"it moves, it was read at .*, then at .*: enable it when it rests"):
        bench.run(bench.driver.enable("index"))
    assert bench.hand.written == []


def test_enable_believes_no_single_position() -> None:
    bench = Bench()
    bench.altered = [(1146, 40000)]
    assert bench.run(bench.driver.enable("index")) == 0
    assert targets_written(bench.hand) == []


@pytest.mark.parametrize(
    ("state", "reason"), [("init", "still initialising"), ("wait", "still initialising"), ("calibration", "waits")]
)
def test_a_hand_that_is_not_ready_is_not_enabled(state: str, reason: str) -> None:
    bench = Bench()
    bench.hand.state, bench.hand._ready = state, 99.0
    with pytest.raises(DeviceError, match=reason) as refused:
        bench.run(bench.driver.enable("index"))
    assert str(refused.value).count(reason) == 1
    assert bench.hand.written == []


def test_a_hand_that_does_not_keep_what_was_written_is_not_enabled() -> None:
    bench = Bench()
    bench.altered = [(1126, 65535), (1126, 65535)]
    with pytest.raises(DeviceError, match="register speed reads 65535 after 65534 was written"):
        bench.run(bench.driver.enable("index"))


# What a goal changed is put back


@MAPS
def test_the_effort_of_one_goal_does_not_outlive_it(name: str) -> None:
    bench = bench_of(name)
    own = packaged_models()[name].default_current
    bench.hand.poke("current_limit", 1, own - 78)
    bench.enable("index")
    limits = []
    for effort in (30, None, None, 60, None):
        bench.move(goal("index", 10, effort=effort))
        limits.append(bench.read("index", "current_limit", raw=True))
    assert limits == [round(0.3 * own), own - 78, own - 78, round(0.6 * own), own - 78]


def test_enabling_again_does_not_take_the_effort_of_a_goal_for_its_own() -> None:
    bench = Bench().enable("index")
    bench.move(goal("index", 10, effort=30))
    bench.after(1).enable("index")
    bench.move(goal("index", 10))
    assert bench.read("index", "current_limit", raw=True) == 1178
    bench.write("index", "current_limit", 0.5)
    bench.move(goal("index", 20, effort=30))
    bench.move(goal("index", 30))
    assert bench.read("index", "current_limit") == 0.5, "what a user has written is its own"


def test_the_speed_of_one_goal_does_not_outlive_it() -> None:
    bench = Bench().enable("index")
    bench.move(goal("index", 10, speed=5))
    bench.move(goal("index", 20))
    assert bench.read("index", "speed", raw=True) == 65534


# A hand without the registers 1115 to 1124


def test_a_lite_is_read_around_the_registers_that_it_does_not_have() -> None:
    """It refuses a read across them (its document omits 1115 to 1124)."""
    bench = Bench()
    bench.hand.poke("hw_version", 0, 0x2501)
    for address in range(1115, 1125):
        del bench.hand._table[address]
    bench.run(bench.driver.identify("index"))
    bench.enable()
    state = bench.exchange(bench.driver.read_state("index"))["index"]
    assert (state["position"], state["goal"], state["loss"]) == (0, 0, None)
    requests = [poll.request([2]) for poll in bench.driver.polls({"feedback": 20, "health": 5})]
    updates = [bench.exchange(request) for request in requests if request is not None]
    assert {key for update in updates for key in update["index"]} == {"position", "status", "moving", "current", "loss"}
    assert verify(bench, *bench.driver.nodes) == {}
    assert bench.run(bench.driver.fence(2, [], bench.driver.nodes))
