"""Enable moves no joint, whatever the servo's registers hold and whichever answer is altered or lost."""

from __future__ import annotations

from typing import Any

import pytest

from servobus.errors import DeviceError, LimitError, NotSupported, ServobusError
from servobus.protocols.sms.codec import Instruction, Packet
from servobus.values import Goal, ServoGoal, StopTarget
from tests.protocols.sms.bench import Bench
from tests.protocols.sms.states import FAMILIES, moving, put, set_mode, travel


def bench_of(family: str, **keys: Any) -> Bench:
    return Bench({"a": {"id": 1, "model": family, "unit": "step", **keys}})


def limited(family: str, low: int, high: int, **keys: Any) -> Bench:
    bench = bench_of(family, **keys)
    put(bench.devices[1], "min_angle_limit", low)
    put(bench.devices[1], "max_angle_limit", high)
    return bench


# Stored limits


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize(("present", "inside"), [(600, True), (599, False), (800, True), (801, False)])
def test_a_joint_outside_its_stored_limits_is_not_enabled(family: str, present: int, inside: bool, direction: int) -> None:
    bench = limited(family, 600, 800, direction=direction)
    device = bench.devices[1]
    device.joint.position = float(present)
    if inside:
        bench.enable()
    else:
        with pytest.raises(NotSupported, match=r"outside the servo's own stored limits .* Turn it inside by hand"):
            bench.run(bench.driver.enable("a"))
        assert {packet.code for packet in bench.sent} == {Instruction.READ}
    assert travel(bench, device) == 0


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize(("goal", "inside"), [(600, True), (599, False), (800, True), (801, False)])
def test_a_goal_outside_the_stored_limits_is_refused(family: str, goal: int, inside: bool, direction: int) -> None:
    bench = limited(family, 600, 800, direction=direction, limits=[-5000, 5000])
    bench.devices[1].joint.position = 700.0
    bench.enable()
    asked = ServoGoal("a", Goal("position", direction * (goal - bench.devices[1].model.zero)))
    if inside:
        bench.driver.check_goal(asked)
    else:
        with pytest.raises(LimitError, match=r"outside the servo's own stored limits .*: nothing was sent"):
            bench.driver.check_goal(asked)


@pytest.mark.parametrize("family", ["sts", "sms", "sms_cl"])
def test_without_stored_limits_every_turn_is_inside(family: str) -> None:
    bench = limited(family, 0, 0)
    device = bench.devices[1]
    device.joint.position = 9000.0
    bench.enable()
    bench.driver.check_goal(ServoGoal("a", Goal("position", 12_000)))
    assert travel(bench, device) == 0


# One reading


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("number", range(14))
def test_one_altered_position_never_becomes_the_goal(family: str, number: int) -> None:
    """Whichever answer it is; its checksum is right."""
    bench = bench_of(family)
    device = bench.devices[1]
    position, count = device.joint.position, [0]

    def alter(packet: Packet) -> bool:
        reading = packet.code == Instruction.READ
        device.joint.position = position + 300 if reading and count[0] == number else position
        count[0] += reading
        return False

    bench.is_lost = alter
    try:
        bench.run(bench.driver.enable("a"))
    except ServobusError:
        assert bench.register(1, "torque_enable") == 0
    else:
        assert bench.register(1, "goal_position") == position
    device.joint.position = position
    assert travel(bench, device) == 0


@pytest.mark.parametrize("family", FAMILIES)
def test_a_limp_joint_that_moves_is_refused(family: str) -> None:
    bench = bench_of(family)
    device = bench.devices[1]
    device.joint.sag = -1000.0

    def slow(packet: Packet) -> bool:
        bench.now += 0.02
        return False

    bench.is_lost = slow
    with pytest.raises(DeviceError, match="the joint moves"):
        bench.run(bench.driver.enable("a"))
    assert bench.register(1, "torque_enable") == 0


@pytest.mark.parametrize("family", FAMILIES)
def test_a_goal_that_got_lost_is_never_repeated_on_a_sagging_arm(family: str) -> None:
    """It has sagged when the acknowledgement is missing, so the next goal is where it is then."""
    bench = bench_of(family)
    device = bench.devices[1]
    goal = device.memory.registers["goal_position"].address
    lost = [True]

    def first_goal(packet: Packet) -> bool:
        if packet.code == Instruction.WRITE and packet.params[0] == goal and lost:
            lost.pop()
            device.joint.position -= 50
            return True
        return False

    bench.is_lost = first_goal
    position = device.joint.position - 50
    bench.run(bench.driver.enable("a"))
    assert not lost
    assert (bench.register(1, "goal_position"), device.joint.position) == (position, position)
    assert travel(bench, device) == 0


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("number", range(20))
def test_a_lost_answer_ends_enabled_where_it_stood_or_limp(family: str, number: int) -> None:
    bench = bench_of(family)
    device = bench.devices[1]
    count = [0]

    def lost(packet: Packet) -> bool:
        count[0] += 1
        return count[0] == number

    bench.is_unanswered = lost
    try:
        bench.run(bench.driver.enable("a"))
    except ServobusError:
        assert bench.register(1, "torque_enable") == 0
    else:
        assert bench.register(1, "torque_enable") == 1
    assert travel(bench, device) == 0


@pytest.mark.parametrize("family", FAMILIES)
def test_an_enabled_servo_that_moves_is_held_by_enable(family: str) -> None:
    bench = bench_of(family)
    device = moving(bench, "position")

    def slow(packet: Packet) -> bool:
        bench.now += 0.05
        return False

    bench.is_lost = slow
    bench.run(bench.driver.enable("a"))
    assert travel(bench, device) == 0


@pytest.mark.parametrize("family", ["sts", "sms", "sms_cl"])
def test_a_servo_that_turns_at_a_velocity_is_enabled_at_rest(family: str) -> None:
    bench = bench_of(family)
    device = moving(bench, "velocity")
    assert bench.run(bench.driver.enable("a")) is None
    assert travel(bench, device) == 0
    assert bench.register(1, "torque_enable") == 1


# What a goal changed is put back


@pytest.mark.parametrize("mode", ["position", "velocity"])
@pytest.mark.parametrize("family", ["sts", "sms"])
@pytest.mark.parametrize("own", [1000, 700])
def test_the_effort_of_one_goal_does_not_outlive_it(family: str, mode: str, own: int) -> None:
    bench = bench_of(family)
    set_mode(bench.devices[1], mode)
    put(bench.devices[1], "torque_limit", own)
    bench.enable()
    goals: list[Goal] = [Goal("position", 5), Goal("position", 6)] if mode == "position" else [Goal("velocity", 5)] * 2
    bench.move({"a": Goal(goals[0].kind, 5, effort=30)})
    assert bench.register(1, "torque_limit") == 300
    bench.sent.clear()
    bench.move({"a": goals[1]})
    assert (bench.register(1, "torque_limit"), len(bench.sent)) == (own, 1), "in the same frame"
    bench.sent.clear()
    bench.move({"a": goals[0]})
    assert len(bench.sent[0].params) == (7 if mode == "position" else 3), "once is enough"


@pytest.mark.parametrize("configured", [None, 50])
@pytest.mark.parametrize("kind", ["hold", "limp"])
@pytest.mark.parametrize("family", ["sts", "sms"])
def test_the_effort_of_one_goal_does_not_outlive_its_process(family: str, kind: str, configured: float | None) -> None:
    """An exit that holds ends with a stop; the next process takes what it finds for the servo's own."""
    bench = Bench({"a": {"id": 1, "model": family} | ({"torque_limit": configured} if configured else {})})
    put(bench.devices[1], "torque_limit", 700)
    bench.enable()
    bench.move({"a": Goal("position", 5, effort=30)})
    report = bench.run(bench.driver.stop([StopTarget("a", kind, enabled=True)]))["a"]  # type: ignore[arg-type]
    assert report.confirmed
    if configured is None:
        assert bench.register(1, "torque_limit") == 700
    next_process = Bench({"a": bench.options.servos["a"].model_dump(exclude_unset=True)})
    next_process.devices = bench.devices
    next_process.enable()
    next_process.move({"a": 6})
    assert bench.register(1, "torque_limit") == (700 if configured is None else 500)


@pytest.mark.parametrize("family", ["sts", "sms", "sms_cl"])
@pytest.mark.parametrize(("own", "again"), [(0, 254), (40, 40)])
def test_the_acceleration_of_one_goal_does_not_outlive_it(family: str, own: int, again: int) -> None:
    bench = bench_of(family)
    put(bench.devices[1], "acceleration", own)
    bench.enable()
    bench.move({"a": Goal("position", 5, acceleration=500)})
    assert bench.register(1, "acceleration") == 5
    bench.move({"a": Goal("position", 6)})
    assert bench.register(1, "acceleration") == again


@pytest.mark.parametrize("family", ["sts", "sms"])
@pytest.mark.parametrize("how", ["disable", "limp", "enable again"])
def test_what_a_goal_changed_does_not_outlive_enable(family: str, how: str) -> None:
    bench = bench_of(family)
    bench.enable()
    bench.move({"a": Goal("position", 5, effort=30, acceleration=500)})
    if how == "disable":
        bench.run(bench.driver.disable("a"))
        assert (bench.register(1, "torque_limit"), bench.register(1, "acceleration")) == (1000, 254)
    elif how == "limp":
        put(bench.devices[1], "torque_enable", 0)
    bench.enable()
    assert (bench.register(1, "torque_limit"), bench.register(1, "acceleration")) == (1000, 254)


@pytest.mark.parametrize("family", ["sts", "sms"])
def test_an_effort_is_put_back_also_where_the_frame_that_does_it_gets_lost(family: str) -> None:
    """SYNC WRITE has no reply, so it brings what it changes twice."""
    bench = Bench({name: {"id": number, "model": family} for number, name in enumerate("ab", 1)})
    bench.enable()
    bench.move({name: Goal("position", 5, effort=30) for name in "ab"})
    assert bench.register(2, "torque_limit") == 300
    bench.is_lost = lambda packet: True
    bench.move(dict.fromkeys("ab", 6.0))
    bench.is_lost = lambda packet: False
    bench.move(dict.fromkeys("ab", 7.0))
    assert (bench.register(1, "torque_limit"), bench.register(2, "torque_limit")) == (1000, 1000)
    bench.sent.clear()
    bench.move(dict.fromkeys("ab", 8.0))
    assert bench.sent[0].params[:2] == bytes((42, 6)), "then no more"


@pytest.mark.parametrize("family", ["sts", "sms"])
def test_an_effort_whose_acknowledgement_got_lost_is_put_back_too(family: str) -> None:
    bench = bench_of(family)
    bench.enable()
    bench.is_unanswered = lambda packet: packet.code == Instruction.WRITE
    with pytest.raises(ServobusError):
        bench.move({"a": Goal("position", 5, effort=30)})
    bench.is_unanswered = lambda packet: False
    bench.move({"a": Goal("position", 6)})
    assert bench.register(1, "torque_limit") == 1000
