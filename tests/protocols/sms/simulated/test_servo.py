"""Registers and joint of the simulated servo: how goals, limits, torque, modes and offsets move it, and what it measures."""

from __future__ import annotations

import pytest

from servobus.protocols.sms.codec import Instruction
from tests.protocols.sms.single_servo import AT_THE_GOAL, FAMILIES, Master, master_of


@pytest.fixture(params=FAMILIES)
def master(request: pytest.FixtureRequest) -> Master:
    return master_of(request.param)


def test_a_goal_switches_torque_on_and_is_reached_in_time(master: Master) -> None:
    """From the middle at 100 steps/s: half way after half the time, then still at the goal."""
    middle = master.model.zero
    scale = master.model.registers["goal_speed"].scale
    speed = round(100 / scale)
    master.go(middle + 100, speed=speed)
    assert master.read(master.model.torque) == 1
    rate = speed * scale
    master.after(50 / rate)
    names = ("present_position", "present_speed", "moving")
    assert [master.read(name) for name in names] == [middle + 50, speed, 1]
    master.after(50 / rate)
    assert [master.read(name) for name in names] == [middle + 100, 0, 0]
    assert master.after(10).read("present_position") == middle + 100


def test_motion_goes_both_ways(master: Master) -> None:
    """Down as well as up."""
    middle = master.model.zero
    master.go(middle - 100)
    assert master.after(AT_THE_GOAL).read("present_position") == middle - 100


def test_speed_0_is_the_maximum_speed() -> None:
    """And no speed is greater."""
    for speed in (0, 30_000):
        master = master_of("sts", position=1000)
        master.go(3000, speed=speed)
        master.after(1000 / master.model.max_steps_per_second)
        assert master.read("present_position") == 2000


def test_the_time_register_counts_where_it_is_milliseconds() -> None:
    """SCS: used when the speed is 0; STS does not look at it."""
    master = master_of("scs", position=500)
    master.go(600, time=2000)
    assert master.after(1).read("present_position") == 550
    master.go(550, time=1000)  # already there: no way, no speed
    assert master.read("moving") == 0
    other = master_of("sts", position=500)
    other.go(600, time=1000)
    assert other.after(0.5).read("present_position") == 600


def test_limits_stop_the_joint_and_leave_the_goal_register(master: Master) -> None:
    """The servo clamps the goal and reports no error."""
    master.write("min_angle_limit", 300)
    master.write("max_angle_limit", 700)
    for goal, end in ((900, 700), (100, 300)):
        master.go(goal)
        master.after(AT_THE_GOAL)
        assert (master.read("goal_position"), master.read("present_position")) == (goal, end)


def test_torque_off_stops_where_it_is(master: Master) -> None:
    """And torque on goes on to the goal of the register."""
    middle = master.model.zero
    speed = round(100 / master.model.registers["goal_speed"].scale)
    master.go(middle + 200, speed=speed)
    master.after(1).write(master.model.torque, 0)
    stood = master.read("present_position")
    assert middle < stood < middle + 200
    assert master.after(10).read("present_position") == stood
    master.write(master.model.torque, 1)
    assert master.after(10).read("present_position") == middle + 200


def test_no_torque_limit_no_motion() -> None:
    """A torque limit of 0 holds nothing and moves nothing."""
    master = master_of("sts", position=1000)
    master.write("torque_limit", 0)
    master.go(2000)
    assert master.after(10).read("present_position") == 1000


def test_a_wheel_runs_at_signed_speed() -> None:
    """Mode 1: past a whole turn, backwards too, and 0 is rest."""
    master = master_of("sts", position=4000)
    scale = master.model.registers["goal_speed"].scale
    master.write("mode", 1)
    master.write("goal_speed", round(200 / scale))
    assert master.after(1).read("present_position") == 4000  # torque is off
    master.write(master.model.torque, 1)
    assert master.after(1).read("present_position") == 104
    master.write("goal_speed", -round(200 / scale))
    assert master.after(1).read("present_position") == 4000
    assert master.read("present_speed") == -round(200 / scale)
    master.write("goal_speed", 0)
    assert (master.read("moving"), master.after(9).read("present_position")) == (0, 4000)


def test_scs_is_a_motor_when_both_limits_are_0() -> None:
    """The PWM word at 44 drives it, sign in bit 10 (vendor header SCSCL.h, WritePWM); a speed does not."""
    master = master_of("scs", position=500)
    master.write("min_angle_limit", 0)
    master.write("max_angle_limit", 0)
    master.write("goal_speed", 50)
    master.write(master.model.torque, 1)
    assert master.after(1).read("present_position") == 500
    master.write("goal_time", 1 << 10 | 100)
    fastest = master.model.max_steps_per_second
    assert master.after(1).read("present_position") == (500 - fastest / 10) % 1024
    master.write("goal_time", 0)
    assert (master.read("moving"), master.after(9).read("present_position")) == (0, (500 - fastest / 10) % 1024)


@pytest.mark.parametrize("family", ["sts", "sms", "sms_cl"])
def test_pwm_turns_it_until_the_word_is_0(family: str) -> None:
    master = master_of(family, position=500)
    master.write("mode", 2)
    master.write(master.model.torque, 1)
    master.go(2000)
    assert master.after(1).read("present_position") == 500, "positions count for nothing"
    master.write("goal_time", -100)
    assert master.after(0.1).read("present_position") == round(500 - master.model.max_steps_per_second / 100)
    master.write("goal_time", 0)
    assert master.read("moving") == 0


@pytest.mark.parametrize("family", ["sts", "sms"])
def test_a_goal_in_step_mode_is_a_way_from_here(family: str) -> None:
    master = master_of(family, position=1000)
    master.write("mode", 3)
    master.write(master.model.torque, 1)
    assert master.after(10).read("present_position") == 1000, "a mode that begins has no goal yet"
    master.go(1500)
    assert master.after(10).read("present_position") == 2500
    master.go(-300)
    assert master.after(10).read("present_position") == 2200
    master.go(1000, speed=100)
    master.after(1).write("goal_position", 0)
    assert (master.read("moving"), master.after(10).read("present_position")) == (0, 2300)


@pytest.mark.parametrize("family", ["sts", "sms", "sms_cl"])
def test_a_bit_of_phase_makes_a_count_of_speed_50_steps(family: str) -> None:
    """FEETECH memory table, 18: bit 2 chooses 0.732 or 0.0146 rpm."""
    master = master_of(family, position=1000)
    master.write("phase", 0)
    master.go(3000, speed=10)
    assert master.read("present_speed") == 10
    assert master.after(1).read("present_position") == 1500


def test_a_protection_takes_the_torque_and_gravity_does_the_rest(master: Master) -> None:
    master.go(700)
    position = master.after(AT_THE_GOAL).read("present_position")
    master.device.joint.sag = -10.0
    assert master.after(1).read("present_position") == position
    master.device.trip(master.now)
    reply = master.send(Instruction.PING)
    assert reply is not None
    assert (master.read(master.model.torque), reply.code) == (0, 0x20)
    assert master.after(1).read("present_position") == position - 10


def test_it_may_pose_as_another_servo(master: Master) -> None:
    master.device.pose_as(0, 10, 4)
    reply = master.send(Instruction.READ, bytes((2, 3)))
    assert reply is not None
    assert reply.params == bytes((0, 10, 4))
    master.device.restart(master.now)
    assert master.device.memory.read(2, 3) == bytes((0, 10, 4))


def test_without_limits_turns_are_counted() -> None:
    """Both limits 0 on STS: beyond one turn and below none; a restart forgets the turns."""
    master = master_of("sts", position=1000)
    master.write("min_angle_limit", 0)
    master.write("max_angle_limit", 0)
    master.go(9000)
    assert master.after(AT_THE_GOAL).read("present_position") == 9000
    master.go(-100)
    assert master.after(AT_THE_GOAL).read("present_position") == -100
    master.device.reboot(master.now)
    assert master.after(10).read("present_position") == 3996


@pytest.mark.parametrize(("family", "mode"), [("sts", 7), ("sms_cl", 3)])
def test_a_mode_that_the_model_does_not_know_rests(family: str, mode: int) -> None:
    master = master_of(family, position=1000)
    master.send(Instruction.WRITE, bytes((master.model.registers["mode"].address, mode)))
    master.go(700)
    assert master.after(10).read("present_position") == 1000


def test_the_offset_shifts_the_reported_position() -> None:
    """present = (raw - offset) mod steps per turn."""
    master = master_of("sts", position=100)
    master.write("position_offset", 200)
    assert master.read("present_position") == 3996
    master.write("position_offset", -50)
    assert master.read("present_position") == 150
    master.device.reboot(0.0)
    assert master.after(10).read("present_position") == 100


@pytest.mark.parametrize("position", [0, 1, 100, 2048, 4095])
def test_torque_128_makes_the_position_the_middle(position: int) -> None:
    """It is kept though the lock is on; torque stays what it was. Exactly half a turn off no offset can hold."""
    master = master_of("sts", position=position)
    master.send(Instruction.WRITE, b"\x28\x80")
    assert master.read(master.model.torque) == 0
    master.device.reboot(0.0)
    assert master.after(10).read("present_position") == (2047 if position == 0 else 2048)


def test_load_follows_speed_and_ends_at_the_torque_limit() -> None:
    """Full load where something holds the joint, none where it rests."""
    master = master_of("sts", position=1000)
    fastest = master.model.max_steps_per_second
    master.go(3000, speed=round(fastest / 2 / master.model.registers["goal_speed"].scale))
    assert master.after(0.1).read("present_load") == 500
    assert master.read("present_current") > 0
    master.device.joint.stuck = True
    stood = master.read("present_position")
    assert master.after(1).read("present_load") == 1000
    assert (master.read("present_position"), master.read("moving"), master.read("present_goal_position")) == (stood, 0, 3000)
    master.write("torque_limit", 300)
    assert master.read("present_load") == 300
    master.go(0)
    assert master.read("present_load") == -300
    master.write(master.model.torque, 0)
    assert (master.read("present_load"), master.read("present_current")) == (0, 0)


def test_it_warms_up_and_cools_down(master: Master) -> None:
    """Slowly, and only under load; the voltage is what it is."""
    cold = master.read("present_temperature")
    master.go(700)
    master.device.joint.stuck = True
    assert cold < master.after(60).read("present_temperature") < 70
    master.device.joint.stuck = False
    assert master.after(2000).read("present_temperature") == cold
    assert master.read("present_voltage") == round(master.device.voltage / master.model.registers["present_voltage"].scale)


def test_time_that_passed_already_changes_nothing(master: Master) -> None:
    """A question about the past is answered with the present."""
    master.go(700)
    master.after(AT_THE_GOAL).read("present_position")
    assert master.after(-50).read("present_position") == 700
