"""The verbs of the driver against the simulated servos."""

from __future__ import annotations

from typing import Any

import pytest

from servobus.errors import DeviceError, LimitError, NotSupported, ReplyTimeout, UnknownName
from servobus.protocols.base import Driver, run_plan
from servobus.protocols.kst.codec import Command, encode
from servobus.protocols.kst.driver import KstDriver
from servobus.values import Goal, ServoGoal, StopTarget
from tests.protocols.kst.bench import Bench, changed_model, goal


def test_it_is_a_driver() -> None:
    driver: Driver = Bench().driver
    assert dict(driver.nodes) == {"pan": 1, "tilt": 2}
    assert driver.step("pan") == 0.1


@pytest.mark.parametrize(
    ("keys", "fields", "speed"),
    [
        ({}, {}, 60.0),
        ({"max_speed": 90}, {}, 90.0),
        ({"max_speed": 90, "speed": 45}, {}, 45.0),
        ({"max_speed": 90}, {"speed": 10.0}, 10.0),
        ({}, {"duration": 0.5}, 40.0),
        ({}, {"duration": 0.5, "value": 10.0}, 60.0),  # no distance: the speed of a goal that names none
    ],
)
def test_the_host_keeps_the_speed(keys: dict[str, Any], fields: dict[str, Any], speed: float) -> None:
    driver = Bench({"pan": {"id": 1, **keys}}).driver
    wanted = Goal(**{"kind": "position", "value": 30.0, **fields})
    assert driver.host_speed(ServoGoal("pan", wanted, start=10.0)) == speed


def test_the_host_keeps_no_speed_from_an_unknown_position() -> None:
    with pytest.raises(LimitError, match="its position is not known"):
        Bench().driver.host_speed(ServoGoal("pan", Goal("position", 1.0)))


# Who is there


def test_ping_reads_the_id() -> None:
    """KST RS422, 3, has no torque, stop or speed command."""
    bench = Bench()
    assert bench.exchange(bench.driver.ping(2)) is None
    assert bench.frames() == [encode(2, Command.READ_ID)]
    with pytest.raises(ReplyTimeout):
        bench.exchange(bench.driver.ping(3))


def test_the_question_nobody_answers_goes_to_a_free_id() -> None:
    assert Bench().driver.unused().node == 254
    assert Bench({"pan": {"id": 254}}).driver.unused().node == 253
    full = Bench({"pan": {"id": 1}}, id_range=[1, 1])
    assert full.driver.unused().node == 1


# Reading


def test_reading_the_state_brings_the_position() -> None:
    bench = Bench({"pan": {"id": 1, "zero": 100, "direction": -1}})
    assert bench.exchange(bench.driver.read_state("pan")) == {"pan": {"position": 0}}


def test_polls_ask_each_servo_that_is_reachable() -> None:
    bench = Bench(status_bits={0: "hot"})
    bench.devices[1].status_bytes = b"\x01\x02"
    polls = bench.driver.polls({"feedback": 50.0, "health": 1.0})
    assert [(poll.name, poll.hz, poll.nodes) for poll in polls] == [
        ("feedback", 50.0, (1,)),
        ("feedback", 50.0, (2,)),
        ("health", 1.0, (1,)),
        ("health", 1.0, (2,)),
    ]
    requests = [poll.request({2}) for poll in polls]
    assert [request is not None for request in requests] == [False, True, False, True]
    assert [bench.exchange(request) for request in requests if request] == [
        {"tilt": {"position": 0}},
        {"tilt": {"status": 0x0201}},
    ]
    assert bench.driver.fault_names("tilt", None) == ("hot",)


def test_status_bits_are_reported_only_where_they_have_a_name() -> None:
    """KST RS422, 3.7: the two status bytes are defined as needed."""
    assert Bench().driver.fault_names("pan", 0xFFFF) == ()
    bench = Bench(status_bits={15: "stalled", 1: "hot"})
    assert bench.driver.fault_names("pan", 0xFFFF) == ("hot", "stalled")
    assert bench.driver.fault_names("pan", 0x8000) == ("stalled",)
    assert bench.driver.fault_names("pan", None) == ()
    own = Bench(model=changed_model(status_bits={0: "brake", 1: "warm"}), status_bits={1: "hot"})
    assert own.driver.fault_names("pan", 3) == ("brake", "hot")


def test_a_position_outside_the_range_is_flagged() -> None:
    """KST RS422, 3.5: -90 to +90 degrees."""
    bench = Bench()
    bench.devices[0].position = bench.devices[0].goal = 920
    assert bench.exchange(bench.driver.read_state("pan")) == {"pan": {"position": 92}}
    assert bench.driver.fault_names("pan", None) == ("outside range",)
    bench.devices[0].position = bench.devices[0].goal = 951
    with pytest.raises(DeviceError, match="garbled, or turned past its stop"):
        bench.exchange(bench.driver.read_state("pan"))


@pytest.mark.parametrize(
    ("name", "value", "raw"),
    [
        ("id", 1, 1),
        ("position", -10.9, -109),
        ("present_position", -10.9, -109),
        ("status", 0x3412, 0x3412),
        ("firmware_version", "1.00", int.from_bytes(b"1.00", "little")),
        ("firmware", "1.00", int.from_bytes(b"1.00", "little")),
    ],
)
def test_what_can_be_read_by_name(name: str, value: object, raw: int) -> None:
    """KST RS422, 3.4 to 3.8."""
    bench = Bench()
    bench.devices[0].position = bench.devices[0].goal = -109
    bench.devices[0].status_bytes = b"\x12\x34"
    assert bench.exchange(bench.driver.read_register("pan", name)) == value
    assert bench.exchange(bench.driver.read_register("pan", name, raw=True)) == raw


def test_reading_may_bring_the_goal() -> None:
    """KST RS422, 3.6: whether the actual or the commanded position is read is not stated."""
    bench = Bench()
    bench.devices[0].reads_goal = True
    bench.run(bench.driver.enable("pan"))
    for turn in bench.driver.plan_goals([goal("pan", 45)], together=False, confirm=False):
        bench.run(turn.plan)
    assert bench.exchange(bench.driver.read_register("pan", "position")) == 45


@pytest.mark.parametrize("name", ["goal_position", "baud_rate"])
def test_what_can_only_be_written_is_not_read(name: str) -> None:
    with pytest.raises(NotSupported, match="can only be written"):
        Bench().driver.read_register("pan", name)


@pytest.mark.parametrize(
    ("name", "reason"),
    [("goal_position", "use move"), ("id", "set_id"), ("baud_rate", "set_baudrate"), ("status", "can only be read")],
)
def test_nothing_is_written_by_name(name: str, reason: str) -> None:
    with pytest.raises(NotSupported, match=reason):
        Bench().driver.write_register("pan", name, 1, persist=True)


def test_unknown_names_are_refused() -> None:
    driver = Bench().driver
    with pytest.raises(UnknownName, match="no register 'temperature'; it has baud_rate, firmware_version"):
        driver.read_register("pan", "temperature")
    with pytest.raises(UnknownName):
        driver.write_register("pan", "torque", 1)


# Motion


def test_enable_reads_the_position_twice_and_writes_nothing() -> None:
    """There is no torque command, and to write a reading could move the servo."""
    bench = Bench()
    bench.devices[0].position = bench.devices[0].goal = 250
    assert bench.run(bench.driver.enable("pan")) == 25
    assert bench.frames() == [encode(1, Command.READ_POSITION)] * 2
    assert bench.devices[0].goal == 250


def test_enable_believes_no_single_reading() -> None:
    """One altered reply with a right sum would be where the servo starts from."""
    bench = Bench()
    bench.altered = [900]
    assert bench.run(bench.driver.enable("pan")) == 0


def test_a_servo_that_moves_is_not_enabled() -> None:
    """Somebody else has sent it there: from a reading on its way nothing can be concluded."""
    bench = Bench(model=changed_model(max_steps_per_second=300.0))
    bench.devices[0].goal = 900.0
    with pytest.raises(DeviceError, match=r"it moves, it was read at \d.*, then at \d.*: enable it when it rests"):
        bench.run(bench.driver.enable("pan"))
    bench.devices[0].goal = bench.devices[0].position
    bench.run(bench.driver.enable("pan"))
    assert Command.SET_POSITION not in [frame[3] for frame in bench.frames()]


@pytest.mark.parametrize(
    ("fields", "error", "reason"),
    [
        ({"kind": "velocity"}, NotSupported, "positions only"),
        ({"acceleration": 10.0}, NotSupported, "acceleration: a KST servo has no command"),
        ({"effort": 50.0}, NotSupported, "effort: a KST servo has no command"),
        ({"speed": 0.0}, LimitError, "the host keeps the speed of a KST servo"),
        ({"value": 90.1}, LimitError, "outside the servo's range -90 to 90"),
        ({"value": -90.1}, LimitError, "outside the servo's range"),
    ],
)
def test_goals_the_wire_cannot_carry_are_refused(fields: dict[str, Any], error: type[Exception], reason: str) -> None:
    wanted = ServoGoal("pan", Goal(**{"kind": "position", "value": 10.0, **fields}))
    with pytest.raises(error, match=reason):
        Bench().driver.check_goal(wanted)


def test_goals_the_wire_can_carry_pass() -> None:
    driver = Bench().driver
    for wanted in (goal("pan", 90.0), goal("pan", -90.0), goal("pan", 0, speed=30.0), goal("pan", 0, duration=1.0)):
        driver.check_goal(wanted)
    with pytest.raises(UnknownName, match="no servo nobody"):
        driver.check_goal(goal("nobody", 0))


def test_a_plan_outside_the_range_is_refused_too() -> None:
    with pytest.raises(LimitError):
        Bench().driver.plan_goals([goal("pan", 90.1)], together=False, confirm=False)


def test_a_lenient_and_other_version_line_works_end_to_end() -> None:
    """The version byte and the check of unused data bytes can be changed."""
    bench = Bench(version_byte=0xCB, pad_check="ignore", min_gap_us=100)
    assert run_plan(bench.driver.identify("pan"), bench.exchange).firmware == "1.00"
    assert {request.frame[1] for request in bench.sent} == {0xCB}
    assert {request.quiet_after for request in bench.sent} == {100e-6}


def test_driver_is_made_from_options_and_models() -> None:
    bench = Bench({})
    assert isinstance(bench.driver, KstDriver)
    assert bench.driver.nodes == {}


# Stops of servos that were not enabled


def test_what_another_program_moves_is_stopped_too() -> None:
    """A servo that was not enabled may be on its way all the same: from a program that was killed, say."""
    bench = Bench(model=changed_model(max_steps_per_second=200.0))
    bench.devices[0].goal = 800.0
    reports = bench.after(1).run(bench.driver.stop([StopTarget("pan", "hold", enabled=False)]))
    assert (reports["pan"].action, reports["pan"].written, reports["pan"].confirmed) == ("hold", True, True)
    stopped = bench.devices[0].goal
    assert bench.after(3).devices[0].position == stopped < 300


def test_an_exit_leaves_alone_what_moves_after_a_restart() -> None:
    bench = Bench(model=changed_model(max_steps_per_second=200.0))
    bench.devices[0].goal = 800.0
    report = bench.after(1).run(bench.driver.stop([StopTarget("pan", "hold", enabled=False, leave_alone=True)]))["pan"]
    assert (report.action, report.written, report.confirmed, bench.frames()) == ("none", False, True, [])


def test_what_is_not_known_to_rest_is_not_confirmed() -> None:
    bench = Bench()
    bench.devices[0].dead = True
    stops = [StopTarget("pan", "hold", enabled=False), StopTarget("tilt", "hold", enabled=False, reachable=False)]
    reports = bench.run(bench.driver.stop(stops))
    assert [(each.written, each.confirmed) for each in reports.values()] == [(False, False)] * 2
