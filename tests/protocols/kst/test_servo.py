"""A configured servo: degrees and steps, the edges of its range, and its travel range."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobus.errors import DeviceError, LimitError
from servobus.protocols.kst.codec import encode_position
from servobus.protocols.kst.model import packaged_model
from servobus.protocols.kst.options import KstServo
from servobus.protocols.kst.servo import CalibratedServo
from servobus.values import Loss
from tests.protocols.kst.bench import steady


def fitted(**options: Any) -> CalibratedServo:
    return CalibratedServo("pan", KstServo.model_validate({"id": 1, **options}), packaged_model())


def steps(raw: int) -> bytes:
    return encode_position(raw) + bytes(6)


@pytest.mark.parametrize(
    ("position", "raw"),
    [
        (0.05, 0),
        (0.15, 2),
        (0.25, 2),
        (0.35, 4),
        (0.45, 4),
        (-0.05, 0),
        (-0.15, -2),
        (-0.25, -2),
        (0.06, 1),
        (0.149, 1),
        (0.151, 2),
        (89.95, 900),
    ],
)
def test_the_nearest_step_and_ties_to_even(position: float, raw: int) -> None:
    """KST RS422, 3.5: a step is 0.1 degrees."""
    assert fitted().to_raw(position) == raw


@pytest.mark.parametrize("position", [90.0, -90.0, 89.99, 0.0, -0.0])
def test_the_ends_of_the_range_pass(position: float) -> None:
    assert abs(fitted().to_raw(position)) <= 900


@pytest.mark.parametrize("position", [90.1, -90.1, 90.01, -90.01, 3276.8, 1e300])
def test_outside_the_range_is_refused_however_little(position: float) -> None:
    """KST RS422, 3.5: -90 to +90 degrees."""
    with pytest.raises(LimitError, match=r"pan: position .* is outside the servo's range -90 to 90: nothing was sent"):
        fitted().to_raw(position)


def test_on_limit_clamp_does_not_widen_the_range() -> None:
    with pytest.raises(LimitError):
        fitted(on_limit="clamp").to_raw(90.1)


@pytest.mark.parametrize(("position", "fits"), [(10.0, True), (10.1, False), (-20.0, True), (-20.1, False)])
def test_range_deg_narrows_it(position: float, fits: bool) -> None:
    servo = fitted(range_deg=[-20, 10])
    if fits:
        assert servo.to_raw(position) == round(10 * position)
    else:
        with pytest.raises(LimitError, match="-20 to 10"):
            servo.to_raw(position)


def test_calibration_turns_the_range_with_it() -> None:
    servo = fitted(zero=100, direction=-1, gear=2.0)
    assert servo.to_raw(0) == 100
    assert servo.to_raw(50) == -900
    assert servo.to_unit(-900) == 50
    with pytest.raises(LimitError, match="range -40 to 50"):
        servo.to_raw(50.1)
    assert servo.to_raw(-40) == 900


def test_other_units() -> None:
    assert fitted(unit="rad").to_raw(math.pi / 2) == 900
    assert fitted(unit="step").to_raw(-900) == -900
    assert fitted(unit="step").to_unit(3) == 3


@steady
@given(st.integers(-900, 900))
def test_every_step_comes_back(raw: int) -> None:
    servo = fitted()
    assert servo.to_raw(servo.to_unit(raw)) == raw
    assert servo.read_position(steps(raw)) == raw / 10


@steady
@given(st.floats(-90, 90))
def test_no_step_is_further_than_half_of_one(position: float) -> None:
    servo = fitted()
    assert abs(servo.to_unit(servo.to_raw(position)) - position) <= 0.05 + 1e-6


@pytest.mark.parametrize(
    ("raw", "believed", "outside"),
    [(900, True, False), (901, True, True), (950, True, True), (951, False, False), (-950, True, True), (-951, False, False)],
)
def test_a_reading_outside_is_a_fault_and_far_outside_refused(raw: int, believed: bool, outside: bool) -> None:
    """KST RS422, 3.5: -90 to +90 degrees."""
    servo = fitted()
    if believed:
        assert servo.decode_position(steps(raw)) == {"position": raw / 10}
    else:
        with pytest.raises(DeviceError, match="beyond -950 to 950"):
            servo.decode_position(steps(raw))
    assert servo.outside is outside


def test_the_flag_goes_when_it_is_back() -> None:
    servo = fitted()
    servo.read_steps(steps(905))
    servo.read_steps(steps(900))
    assert not servo.outside


def test_status_bytes_are_raw() -> None:
    """KST RS422, 3.7: the two status bytes are defined as needed."""
    servo = fitted()
    assert servo.decode_status(b"\x01\x80" + bytes(6)) == {"status": 0x8001}
    assert servo.status == 0x8001


# Where it can be


@pytest.mark.parametrize(("raw", "jumped"), [(350, False), (351, True), (50, False), (49, True)])
def test_a_servo_that_is_read_twice_outside_its_travel_range_has_jumped(raw: int, jumped: bool) -> None:
    """Between 10 and 30 degrees, and five more on each side, any reading is possible. One reading may be an altered reply."""
    servo = fitted()
    travel = servo.travel
    travel.begin(100)
    travel.send(300)
    travel.confirm(300)
    first = servo.decode_position(steps(raw))
    assert (travel.jumped, travel.last) == (False, 100 if jumped else raw)
    assert ("loss" in first) is not jumped, "it tells nothing yet"
    second = servo.decode_position(steps(raw))
    assert (travel.jumped, travel.last) == (jumped, raw)
    assert second["loss"] is (Loss.RESTARTED if jumped else None)


def test_one_altered_reading_between_right_ones_is_no_jump() -> None:
    servo = fitted()
    servo.travel.begin(0)
    for raw in (0, 800, 0, -800, 0):
        servo.travel.read(raw)
        assert servo.travel.last == 0
    assert not servo.travel.jumped


def test_a_servo_that_leaves_its_goal_slowly_has_jumped() -> None:
    """KST RS422, 3.5: after a restart it goes to its default position; it may be read on its way there."""
    travel = fitted().travel
    travel.begin(600)
    for raw in range(600, 540, -5):
        assert not travel.jumped
        travel.read(raw)
    travel.read(540)
    assert travel.jumped


def test_readings_of_a_servo_that_others_may_move_tell_no_restart() -> None:
    servo = fitted()
    assert servo.decode_position(steps(10)) == {"position": 1.0}


def test_all_goals_since_the_last_reading_count() -> None:
    travel = fitted().travel
    travel.begin(0)
    for raw in (300, -200, 100):
        travel.send(raw)
        travel.confirm(raw)
    jumped = []
    for raw in (290, 150, -100, -100):
        travel.read(raw)
        jumped.append(travel.jumped)
    assert jumped == [False, False, False, True]


def test_a_goal_that_may_have_been_obeyed_counts_as_well() -> None:
    """Also after a reading on the way to it, and until a later goal is confirmed."""
    travel = fitted().travel
    travel.begin(0)
    travel.send(500)
    travel.read(240)
    travel.read(480)
    assert not travel.jumped
    travel.send(100)
    travel.confirm(100)
    travel.read(100)
    travel.read(480, sure=True)
    assert travel.jumped


def test_enabling_forgets_the_jump_and_disabling_the_question() -> None:
    travel = fitted().travel
    travel.begin(0)
    travel.read(700, sure=True)
    jumped = [travel.jumped]
    travel.begin(700)
    jumped.append(travel.jumped)
    travel.end()
    travel.send(300)
    travel.read(0)
    assert [*jumped, travel.jumped] == [True, False, False]


def test_a_stop_holds_the_last_confirmed_goal_else_the_last_reading() -> None:
    servo = fitted()
    servo.begin_lead(5.0)
    travel = servo.travel
    held = [servo.hold_steps(None)]
    steps: list[tuple[Callable[[int], None], int]] = [
        (travel.read, 120),
        (travel.begin, 150),
        (travel.send, 190),
        (travel.confirm, 190),
        (travel.read, 180),
        (travel.read, 0),  # one reading may be altered
        (travel.read, 0),  # restarted: to send it back to its goal would move it
    ]
    for step, raw in steps:
        step(raw)
        held.append(servo.hold_steps(None))
    assert held == [None, 120, 150, 150, 190, 190, 190, 0]


def test_a_stop_holds_the_setpoint_inside_the_travel_range() -> None:
    """A setpoint that never left for the servo, such as the end of a ramp, moves nothing."""
    servo = fitted()
    assert servo.hold_steps(20.0) is None  # others may have moved it: it is read first
    servo.begin_lead(3.0)
    servo.travel.begin(100)
    servo.travel.send(150)
    servo.travel.read(120)
    assert [servo.hold_steps(position) for position in (13.0, 15.0, 60.0, -60.0)] == [130, 150, 150, 120]
    servo.travel.read(-300, sure=True)
    assert servo.hold_steps(13.0) == -300


@pytest.mark.parametrize("setpoint", [None, 60.0])
def test_what_a_stop_holds_is_at_most_one_lead_from_where_the_servo_was_read(setpoint: float | None) -> None:
    """It may have been sent farther than it has come: a stop must not let it travel on."""
    servo = fitted()
    servo.travel.begin(0)
    servo.travel.send(600)
    servo.travel.confirm(600)
    servo.begin_lead(1.2)
    servo.travel.read(80)
    assert servo.hold_steps(setpoint) == 92


# How far it may be sent


@pytest.mark.parametrize(
    ("wanted", "present", "held", "sent"),
    [
        (212, 200, 200, 212),  # it follows
        (212, 195, 200, 207),  # it lags a little: it is sent less
        (212, 180, 200, None),  # it is farther behind the goal that it holds than a lead: it keeps that goal
        (212, 180, None, 192),  # its goal is not known: nothing ahead of where it is
        (188, 195, 200, 188),  # it turns round
        (188, 206, 200, 194),
        (900, 920, None, 900),  # outside its range it may only come back
    ],
)
def test_a_setpoint_is_at_most_one_lead_ahead_of_where_the_servo_was_read(
    wanted: int, present: int, held: int | None, sent: int | None
) -> None:
    servo = fitted()
    servo.travel.begin(present)
    if held is not None:
        servo.travel.send(held)
        servo.travel.confirm(held)
    servo.begin_lead(1.2)
    assert servo.ahead(wanted, present) == sent


@pytest.mark.parametrize(("lead", "steps"), [(0.01, 5), (0.5, 5), (0.51, 6), (1.2, 12), (3.0, 30)])
def test_a_lead_is_never_less_than_a_servo_under_load_may_rest_off_its_goal(lead: float, steps: int) -> None:
    servo = fitted()
    servo.begin_lead(lead)
    assert servo.travel.lead == steps


def test_what_a_stop_holds_is_inside_the_servos_range() -> None:
    servo = fitted()
    servo.travel.read(904)
    assert servo.hold_steps(None) == 900
    servo.travel.read(-904)
    assert servo.hold_steps(None) == -900
