"""Registers of a hand by name, polls, and what the hand refuses."""

from __future__ import annotations

from typing import Any

import pytest

from servobus.errors import DeviceError, LimitError, NotSupported, ReplyTimeout, UnknownName
from servobus.protocols.base import LineTraits, run_plan
from servobus.protocols.modbus.requests import WriteSingle
from servobus.protocols.roh.options import CHANNELS
from tests.protocols.roh.bench import Bench, bench_of, goal

MAPS = pytest.mark.parametrize("name", ["legacy", "v1", "v2"])
READ = 3


# Reading


@MAPS
def test_feedback_is_one_read_and_health_the_fewest(name: str) -> None:
    bench = bench_of(name).enable()
    for number, finger in enumerate(bench.hand.fingers):
        finger.position = 65535 * number / 5
        finger.current = 100 * number
        finger.status = number
    polls = bench.driver.polls({"feedback": 50, "health": 5})
    assert [(poll.name, poll.hz, poll.nodes) for poll in polls] == [
        ("feedback", 50, (2,)),
        ("health", 5, (2,)),
        ("health", 5, (2,)),
    ]
    assert [poll.request([]) for poll in polls] == [None] * 3
    updates: dict[str, dict[str, Any]] = {}
    for poll in polls:
        request = poll.request([2])
        for servo, update in (bench.exchange(request) if request else {}).items():
            updates.setdefault(servo, {}).update(update)
    position = {"legacy": "1135 to 1140", "v1": "1145 to 1150", "v2": "1145 to 1150"}[name]
    health = {"legacy": ["1095 to 1120", "1165 to 1170"]}.get(name, ["1085 to 1130"])
    assert bench.frames() == [f"unit 2 READ {span}" for span in (position, *health)]
    assert [updates[servo]["position"] for servo in CHANNELS] == [0, 20, 40, 60, 80, 100]
    assert updates["index"] == {"position": 20, "current": 0.1, "status": 1, "moving": True, "loss": None}
    assert [bench.driver.fault_names(servo, None) for servo in CHANNELS] == [(), (), (), ("over_current",), (), ("stuck",)]


def test_through_an_arm_no_question_is_longer_than_it_carries() -> None:
    bench = Bench()
    bench.driver.use_traits(LineTraits(max_read=12, max_write=10))
    bench.enable()
    reads = [poll.request([2]) for poll in bench.driver.polls({"feedback": 50, "health": 5})]
    assert [request.frame[5] for request in reads if request] == [6, 6, 6, 6]
    assert bench.exchange(bench.driver.read_state("index"))["index"]["position"] == 0
    for servo in CHANNELS:
        bench.run(bench.driver.enable(servo))
    assert bench.run(bench.driver.fence(2, [], bench.driver.nodes))
    assert max(request.frame[5] for request in bench.sent if request.frame[1] == READ) <= 12
    with pytest.raises(NotSupported, match=r"has 18 words, one read on this line 12: read it in parts, 2000:12"):
        bench.driver.read_register("thumb_bend", "force_ex")
    with pytest.raises(LimitError, match="LEN 1 to 12"):
        bench.driver.read_register("index", "2000:13")
    assert bench.read("index", "2000:12") == [0] * 12


@MAPS
def test_the_state_is_position_and_status_in_one_read(name: str) -> None:
    bench = bench_of(name).enable()
    bench.hand.fingers[2].position, bench.hand.fingers[2].status = 65535, 5
    request = bench.driver.read_state("middle")
    assert request is bench.driver.read_state("middle")
    state = bench.exchange(request)["middle"]
    assert {"position": 100, "status": 5, "moving": False}.items() <= state.items()
    assert bench.driver.fault_names("middle", state["status"]) == ("stuck",)


def test_registers_are_read_in_their_units() -> None:
    bench = Bench(units={2: {"model": "v1"}}).enable()
    assert bench.read("index", "firmware") == "3.1"
    assert bench.read("index", "protocol_version") == "1.0"
    assert bench.read("index", "fw_version", raw=True) == 0x0301
    assert bench.read("index", "status") == "pos_reached"
    assert bench.read("index", "status", raw=True) == 2
    assert bench.read("index", "finger_p") == 250
    assert bench.read("index", "current_limit") == 1.178
    assert bench.read("index", "force_limit") == 15
    assert bench.read("index", "speed") == pytest.approx(100, abs=0.002)
    assert bench.read("index", "angle") == 178.37
    assert bench.read("index", "cali_thumb_pos") == [0] * 5
    assert bench.read("index", "0x3E8:2") == [0x0100, 0x0301]
    assert bench.driver.read_register("index", "angle") is bench.driver.read_register("index", "angle")


def test_what_cannot_be_read_is_refused_here() -> None:
    bench = Bench(units={2: {"model": "v1"}}).enable()
    with pytest.raises(NotSupported, match="can only be written"):
        bench.driver.read_register("index", "beep_period")
    with pytest.raises(UnknownName, match="no register 'torque'"):
        bench.driver.read_register("index", "torque")
    with pytest.raises(NotSupported, match="thumb_rotation has no register force_limit: only thumb_bend"):
        bench.driver.read_register("thumb_rotation", "force_limit")
    for span in ("1000:0", "1000:65", "65535:2"):
        with pytest.raises(LimitError, match="LEN 1 to 64"):
            bench.driver.read_register("index", span)
    assert bench.driver.read_register("index", "65535:1").frame[5] == 1
    assert bench.driver.read_register("index", "1000:64").frame[5] == 64


# Writing


def test_registers_are_written_once_and_read_back() -> None:
    bench = Bench(units={2: {"model": "v1"}}).enable()
    assert bench.write("index", "force_limit", 5) == 5
    assert bench.frames() == ["unit 2 WRITE 1116 = 5000", "unit 2 READ 1116"]
    assert bench.write("index", "speed", 32768, raw=True) == 32768
    assert bench.driver.fingers["index"].held.settings["speed"] == 32768
    assert bench.write("index", "beep_switch", 0, persist=True) == 0
    assert bench.write("index", "beep_period", 0.25) == 0.25


def test_registers_of_other_verbs_are_not_written_by_name() -> None:
    bench = Bench().enable()
    refused = {
        "node_id": r"commissioning \(set_id\)",
        "recalibrate": "commissioning",
        "reset": "commissioning",
        "start_init": "commissioning",
        "power_off": "commissioning",
        "reset_force": "commissioning",
        "pos_target": "use move",
        "angle_target": "use move",
        "cali_thumb_pos": "several words",
        "reserved": "several words",
        "beep_switch": "add persist",
        "cali_end": "add persist",
        "position": "can only be read",
    }
    for name, why in refused.items():
        with pytest.raises(NotSupported, match=why):
            bench.driver.write_register("index", name, 1)
    for value in (True, 1.5, "1"):
        with pytest.raises(LimitError, match="a raw value is an integer"):
            bench.driver.write_register("index", "speed", value, raw=True)
    for raw in (-1, 65536):
        with pytest.raises(LimitError, match="outside 0 to 65535"):
            bench.driver.write_register("index", "speed", raw, raw=True)
    with pytest.raises(LimitError, match="not a finite number"):
        bench.driver.write_register("index", "speed", float("nan"))
    assert bench.frames() == []


def test_a_write_that_is_saved_or_has_an_effect_is_not_repeated() -> None:
    bench = Bench().enable()
    bench.loses = lambda request: request.frame[1] == 16
    for name, keys in (("beep_switch", {"persist": True}), ("beep_period", {}), ("speed", {})):
        with pytest.raises(ReplyTimeout):
            bench.write("index", name, 1, **keys)
        assert len(bench.frames()) == (3 if name == "speed" else 1)


def test_a_value_that_does_not_read_back_was_not_taken() -> None:
    bench = Bench().enable()
    bench.hand.poke("stall_speed", 1, 7)
    plan = bench.driver.write_register("index", "stall_speed", 9)
    next(plan)
    plan.send(None)
    with pytest.raises(DeviceError, match="reads 7 after 9 was written"):
        plan.send([7])


def test_one_register_is_written_by_0x06_on_request() -> None:
    bench = Bench(single_write="single").enable()
    bench.write("index", "speed", 50)
    assert isinstance(bench.sent[0], WriteSingle)
    bench.frames()
    bench.move(goal("index", 10), goal("middle", 10))
    assert "unit 2 WRITE 1136 to 1137 = 6554 6554" in bench.frames()


# Refusals


@MAPS
def test_a_device_failure_is_followed_by_its_reason_once(name: str) -> None:
    bench = bench_of(name).enable("index")
    address = {"legacy": 1126}.get(name, 1136)
    bench.hand.fails[address] = 4
    error = bench.move(goal("index", 50))["index"]
    assert isinstance(error, DeviceError)
    assert (error.code, error.servo) == (4, "index")
    assert "device failure (4); a motor is stuck: free the finger (4)" in error.message
    where = {"legacy": 1004}.get(name, 1006)
    assert bench.frames() == [f"unit 2 WRITE {address} = 32768", f"unit 2 READ {where}"]


def refused(bench: Bench, sub: list[int] | Exception, code: int = 4) -> DeviceError:
    """The error that a write ends with, when the sub-exception is read so."""

    def exchange(request: Any) -> list[int]:
        if isinstance(sub, Exception):
            raise sub
        return sub

    with pytest.raises(DeviceError) as caught:
        run_plan(bench.driver.hands[2].explained(_raise(DeviceError("no", code=code))), exchange)
    return caught.value


def _raise(error: Exception) -> Any:
    yield from ()
    raise error


def test_reasons() -> None:
    bench = Bench().enable()
    assert refused(bench, [1]).message == "no; it is still initialising: wait, then try again (1)"
    assert refused(bench, [77]).message == "no; a sub-exception that is not documented (77)"
    assert refused(bench, [0]).message == "no"
    assert refused(bench, ReplyTimeout("lost")).message == "no"
    assert refused(bench, [5], 0x0B).message == "no; its last sub-exception: the operation failed (5)"
    with pytest.raises(DeviceError, match="no"):
        next(bench.driver.hands[2].explained(_raise(DeviceError("no", code=2))))
