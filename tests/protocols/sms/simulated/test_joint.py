"""The simulated joint: where it is at a time, and how warm."""

from __future__ import annotations

import math

import pytest

from servobus.protocols.sms.simulated.joint import AMBIENT, RISE, THERMAL_S, Joint


def joint_at(position: float, target: float, rate: float = 100.0, **options: bool) -> Joint:
    """A joint that knows the time: 0."""
    joint = Joint(4096, 1000.0, position, target, rate, driven=True, **options)
    joint.advance(0.0)
    return joint


@pytest.mark.parametrize(("target", "at"), [(1200, 1100), (800, 900), (1100, 1100), (1099, 1099), (1000, 1000)])
def test_it_goes_to_its_target_and_no_further(target: float, at: float) -> None:
    """100 steps either way in a second, the last one too."""
    joint = joint_at(1000, target)
    joint.advance(1.0)
    assert joint.position == at
    assert joint.velocity == (0 if at == target else math.copysign(100, target - 1000))


def test_many_small_steps_equal_one_long_step() -> None:
    """The joint may be advanced any number of times."""
    often, once = joint_at(0, 3000), joint_at(0, 3000)
    for tick in range(1, 101):
        often.advance(tick / 10)
    once.advance(10.0)
    assert often.position == pytest.approx(once.position)
    assert often.temperature == pytest.approx(once.temperature)


def test_the_first_time_moves_nothing() -> None:
    """However late it is."""
    joint = Joint(4096, 1000.0, 0, 500, 100.0, driven=True)
    joint.advance(1e9)
    assert joint.position == 0
    joint.advance(1e9 + 1)
    assert joint.position == pytest.approx(100)


def test_time_does_not_go_back() -> None:
    """A question about the past changes nothing."""
    joint = joint_at(0, 500)
    joint.advance(2.0)
    joint.advance(1.0)
    assert (joint.position, joint.at) == (200, 2.0)


def test_without_drive_it_rests() -> None:
    """No motion, no load."""
    joint = joint_at(0, 500)
    joint.driven = False
    joint.advance(9.0)
    assert (joint.position, joint.velocity, joint.load) == (0, 0, 0)


@pytest.mark.parametrize(("rate", "at"), [(100.0, 46), (-100.0, 3942)])
def test_a_wheel_wraps(rate: float, at: float) -> None:
    """Both ways, and it has no target."""
    joint = joint_at(4042 if rate > 0 else -54 % 4096, 0, rate, wheel=True)
    joint.advance(1.0)
    assert (joint.position, joint.velocity) == (at, rate)


def test_turns_are_counted_where_it_does_not_wrap() -> None:
    """Beyond one turn, and below none."""
    joint = joint_at(4000, 9000, 1000.0, wraps=False)
    joint.advance(9.0)
    assert joint.position == 9000
    joint.target = -9000
    joint.advance(99.0)
    assert joint.position == -9000


def test_load_is_the_share_of_the_maximum_speed() -> None:
    """Signed; all of it where something holds the joint, which then does not move."""
    joint = joint_at(0, -500, 250.0, wraps=False)
    assert joint.load == -0.25
    joint.stuck = True
    assert (joint.load, joint.velocity) == (-1.0, 0.0)
    joint.advance(1.0)
    assert joint.position == 0


def test_it_warms_up_while_it_works_and_cools_down_after() -> None:
    """Towards full load's end by 63 % in one time constant; from the moment it arrived it cools."""
    joint = joint_at(0, 500)
    joint.stuck = True
    joint.advance(THERMAL_S)
    warm = AMBIENT + RISE * (1 - math.exp(-1))
    assert joint.temperature == pytest.approx(warm)
    joint.driven = False
    joint.advance(2 * THERMAL_S)
    assert joint.temperature == pytest.approx(AMBIENT + (warm - AMBIENT) * math.exp(-1))


def test_a_motion_of_half_the_time_warms_for_half_the_time() -> None:
    """The joint stops at the target within the step."""
    whole, halves = joint_at(0, 500, 1000.0), joint_at(0, 500, 1000.0)
    whole.advance(1.0)
    halves.advance(0.5)
    halves.advance(1.0)
    assert whole.temperature == pytest.approx(halves.temperature)
    assert whole.temperature > AMBIENT
