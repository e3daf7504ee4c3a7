"""The verbs of the driver against simulated hands."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from servobus.errors import DeviceError, ReplyTimeout, UnknownName
from servobus.protocols.base import Driver
from servobus.protocols.modbus.codec import pack, reply_key
from servobus.protocols.roh.driver import MAX_FENCE
from servobus.protocols.roh.options import CHANNELS
from servobus.values import Identity
from tests.protocols.roh.bench import Bench, bench_of, goal

MAPS = pytest.mark.parametrize("name", ["legacy", "v1", "v2"])
READ = 3


def outstanding(*counts: int) -> list[Any]:
    return [reply_key(READ, bytes((2 * count,))) for count in counts]


def test_it_is_a_driver() -> None:
    bench = Bench()
    driver: Driver = bench.driver
    assert dict(driver.nodes) == dict.fromkeys(CHANNELS, 2)
    assert driver.step("index") == 0.1
    assert bench.driver.host_speed(goal("index", 50, speed=10)) is None
    assert len(bench.devices) == 1


# Which map


@MAPS
def test_the_first_registers_tell_the_map(name: str) -> None:
    bench = bench_of(name)
    result = bench.run(bench.driver.identify("index"))
    products = {"legacy": "ROH-A001 or A002", "v1": "ROH-A001 or A002", "v2": "ROH-AP001"}
    assert (result.model, result.product, result.mode, result.notes) == (name, products[name], "position", ())
    assert result.firmware == {"legacy": "3.0.68", "v1": "3.1.309", "v2": "3.1.155"}[name]
    assert bench.frames() == ["unit 2 READ 1000 to 1003"]
    assert bench.run(bench.driver.inspect(2)).model == name
    assert bench.driver.hands[2].map.name == name
    assert bench.driver.fault_names("index", None) == ()


def test_a_hand_that_is_not_configured_can_be_inspected() -> None:
    bench = Bench({}, maps={})
    bench.devices = Bench().devices
    assert bench.run(bench.driver.inspect(2)).model == "v2"
    bench.hand.poke("hw_version", 0, 0x7701)
    assert bench.run(bench.driver.inspect(2)).product == "ROH hardware 0x7701"


def refuses(bench: Bench, why: str) -> None:
    """Nothing is written, and each verb says why."""
    result = bench.run(bench.driver.identify("index"))
    assert why in result.notes[0]
    assert bench.driver.fault_names("index", None) == ("register_map",)
    with pytest.raises(DeviceError, match=why):
        bench.run(bench.driver.enable("index"))
    with pytest.raises(DeviceError, match=why):
        bench.driver.check_goal(goal("index", 50))
    error = bench.move(goal("index", 50))["index"]
    assert isinstance(error, DeviceError)
    assert why in error.message
    assert error.servo == "index"
    with pytest.raises(DeviceError, match=why):
        bench.write("index", "beep_period", 0.1)
    assert bench.hand.written == []


@pytest.mark.parametrize(("pinned", "has"), [("legacy", "v1"), ("v1", "v2"), ("v2", "v1"), ("v1", "legacy")])
def test_a_hand_that_has_not_the_pinned_map_is_not_written_to(pinned: str, has: str) -> None:
    bench = bench_of(has, units={2: {"model": pinned}})
    refuses(bench, f"register map {has}, the config pins {pinned}")
    bench.hand.fingers[1].position = 13107
    assert bench.read("index", "position") == 20, "it is read by the map it has"


@MAPS
def test_the_pinned_map_is_fine(name: str) -> None:
    bench = Bench(units={2: {"model": name}}).enable()
    assert bench.move(goal("index", 100)) == {"index": "acked"}


@pytest.mark.parametrize("word", [0x0000, 0x0400, 0x0201, 0xFFFF])
def test_a_hand_with_an_unknown_map_is_not_written_to(word: int) -> None:
    bench = Bench()
    bench.hand.poke("protocol_version", 0, word)
    bench.hand.poke("fw_version", 0, 0x0402)
    refuses(bench, f"0x{word:04X} and 0x0402")
    with pytest.raises(DeviceError, match="none of the maps"):
        bench.read("index", "position")
    assert bench.run(bench.driver.inspect(2)) == Identity(
        product=f"unknown map: registers 1000 and 1001 read 0x{word:04X}, 0x0402"
    )


def test_before_it_was_asked_no_goal_is_taken_and_no_value_believed() -> None:
    bench = bench_of("v1")
    with pytest.raises(DeviceError, match="not asked yet"):
        bench.driver.check_goal(goal("index", 50))
    early = bench.driver.read_register("index", "position")
    with pytest.raises(DeviceError, match="not asked yet"):
        bench.exchange(early)
    poll = bench.driver.polls({"feedback": 50})[0].request([2])
    assert poll is not None
    assert bench.exchange(poll) == {}
    bench.run(bench.driver.identify("index"))
    with pytest.raises(DeviceError, match="register map v1: ask again"):
        bench.exchange(early)
    assert bench.read("index", "position") == 0


def test_a_write_that_was_meant_for_another_map_is_not_sent() -> None:
    bench = bench_of("legacy")
    plan = bench.driver.write_register("index", "beep_period", 0.5)
    with pytest.raises(DeviceError, match="map legacy: nothing was written"):
        bench.run(plan)
    assert bench.hand.written == []
    bench.write("index", "beep_period", 0.5)
    assert bench.hand.beeps == [500]


# Who is there


def test_ping_reads_the_first_register() -> None:
    bench = Bench()
    assert bench.exchange(bench.driver.ping(2)) is None
    assert bench.frames() == ["unit 2 READ 1000"]
    with pytest.raises(ReplyTimeout):
        bench.exchange(bench.driver.ping(3))


def test_the_question_nobody_answers_goes_to_a_free_unit() -> None:
    assert Bench().driver.unused().node == 247
    assert Bench({"index": {"id": 247, "channel": "index"}}).driver.unused().node == 246


# Fences


@pytest.mark.parametrize(
    ("under_way", "limit", "count"),
    [
        ([], 64, 1),
        ([6, 1, 2], 64, 3),
        (range(1, 12), 12, 12),
        (range(1, 126), 125, 1),
        ([*range(2, MAX_FENCE + 1), 1], 64, 2),
    ],
)
def test_a_fence_reads_a_number_of_registers_that_is_not_under_way(under_way: Sequence[int], limit: int, count: int) -> None:
    """When all are, the one that was asked for longest ago."""
    driver = Bench(max_read=limit).driver
    request = next(driver.fence(2, outstanding(*under_way), ()))
    assert request.frame[5] == count


@MAPS
@pytest.mark.parametrize("under_way", [[], [1], list(range(1, 10)), list(range(1, MAX_FENCE))])
def test_every_fence_is_answered_by_every_map(name: str, under_way: list[int]) -> None:
    bench = bench_of(name)
    bench.hand.refuses_write_only = True
    assert bench.run(bench.driver.fence(2, [*outstanding(*under_way), reply_key(16, pack((1, 2)))], ()))
    assert len(bench.frames()) == 1


def test_a_fence_that_was_not_answered_is_followed_by_another() -> None:
    bench = Bench()
    bench.loses = lambda request: request.frame[5] == 1
    assert bench.run(bench.driver.fence(2, [], ()))
    assert bench.frames() == ["unit 2 READ 1000", "unit 2 READ 1000 to 1001"]
    bench.loses = lambda request: True
    with pytest.raises(ReplyTimeout):
        bench.run(bench.driver.fence(2, outstanding(6), ()))
    assert len(bench.frames()) == 2


def test_a_refusal_answers_a_fence_if_no_other_read_is_under_way() -> None:
    bench = Bench()
    bench.hand.max_registers = 0
    assert bench.run(bench.driver.fence(2, [], bench.driver.nodes))
    with pytest.raises(ReplyTimeout):
        bench.run(bench.driver.fence(2, outstanding(6), ()))


@MAPS
def test_a_restart_shows_in_the_targets(name: str) -> None:
    bench = bench_of(name).enable("index", "ring")
    assert bench.run(bench.driver.fence(2, [], bench.driver.nodes)), "nothing has changed"
    assert isinstance(bench.move(goal("index", 50)), dict)
    assert bench.run(bench.driver.fence(2, outstanding(1), bench.driver.nodes))
    bench.hand.reboot(bench.now)
    bench.after(5)
    assert bench.run(bench.driver.fence(2, [], ())), "nobody asked"
    assert not bench.run(bench.driver.fence(2, [], bench.driver.nodes))
    assert not any(finger.held.targets or finger.held.settings for finger in bench.driver.fingers.values())


def test_a_restart_shows_in_the_speeds() -> None:
    bench = Bench().enable("index")
    bench.move(goal("index", 0, speed=20))
    assert bench.run(bench.driver.fence(2, [], bench.driver.nodes))
    bench.hand.reboot(bench.now)
    bench.after(5)
    assert not bench.run(bench.driver.fence(2, [], bench.driver.nodes))


@pytest.mark.parametrize("busy", [True, False])
def test_a_hand_that_initialises_has_restarted(busy: bool) -> None:
    bench = Bench().enable("index")
    bench.hand.refuses_reads_while_busy = True
    bench.hand.state = "init" if busy else "work"
    bench.hand._ready = 99.0
    assert bench.run(bench.driver.fence(2, [], bench.driver.nodes)) is not busy


def test_a_replaced_hand_is_asked_for_its_map_again() -> None:
    bench = Bench().enable("index")
    bench.devices = bench_of("v1").devices
    assert not bench.run(bench.driver.fence(2, [], bench.driver.nodes))
    with pytest.raises(DeviceError, match="another hand answers in its place"):
        bench.driver.check_goal(goal("index", 50))
    assert bench.run(bench.driver.fence(2, [], bench.driver.nodes)), "it is told once"
    bench.run(bench.driver.identify("index"))
    assert bench.driver.hands[2].map.name == "v1"
    bench.devices = Bench().devices
    bench.run(bench.driver.identify("index"))
    assert bench.driver.hands[2].map.name == "v2"


def test_targets_that_may_have_been_applied_are_no_restart() -> None:
    bench = Bench().enable("index")
    bench.loses = lambda request: request.frame[1] == 16
    assert isinstance(bench.move(goal("index", 50))["index"], ReplyTimeout)
    bench.loses = lambda request: False
    assert bench.run(bench.driver.fence(2, [], bench.driver.nodes))


def test_a_finger_nobody_configured() -> None:
    with pytest.raises(UnknownName, match="no servo wrist"):
        Bench().driver.check_goal(goal("wrist", 1))
