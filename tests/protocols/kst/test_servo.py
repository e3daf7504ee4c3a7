"""A configured servo: degrees and steps, the range at its edges, and where it can be at all."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobus.errors import DeviceError, LimitError
from servobus.protocols.kst.codec import encode_position
from servobus.protocols.kst.model_loading import packaged_model
from servobus.protocols.kst.options import KstServo
from servobus.protocols.kst.servo import FittedServo
from tests.protocols.kst.bench import steady


def fitted(**options: Any) -> FittedServo:
    return FittedServo("pan", KstServo.model_validate({"id": 1, **options}), packaged_model())


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
    """K13."""
    assert fitted().to_raw(position) == raw


@pytest.mark.parametrize("position", [90.0, -90.0, 89.99, 0.0, -0.0])
def test_the_ends_of_the_range_pass(position: float) -> None:
    assert abs(fitted().to_raw(position)) <= 900


@pytest.mark.parametrize("position", [90.1, -90.1, 90.01, -90.01, 3276.8, 1e300])
def test_outside_the_range_is_refused_however_little(position: float) -> None:
    """K11."""
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
    assert servo.position(steps(raw)) == raw / 10


@steady
@given(st.floats(-90, 90))
def test_no_step_is_further_than_half_of_one(position: float) -> None:
    servo = fitted()
    assert abs(servo.to_unit(servo.to_raw(position)) - position) <= 0.05 + 1e-6


@pytest.mark.parametrize(
    ("raw", "believed", "outside"),
    [(900, True, False), (901, True, True), (950, True, True), (951, False, False), (-950, True, True), (-951, False, False)],
)
def test_a_reading_slightly_outside_is_flagged_and_far_outside_not_believed(raw: int, believed: bool, outside: bool) -> None:
    """K11."""
    servo = fitted()
    if believed:
        assert servo.decode_position(steps(raw)) == {"position": raw / 10}
    else:
        with pytest.raises(DeviceError, match="beyond -950 to 950"):
            servo.decode_position(steps(raw))
    assert servo.outside is outside


def test_the_flag_goes_when_it_is_back() -> None:
    servo = fitted()
    servo.position_of(steps(905))
    servo.position_of(steps(900))
    assert not servo.outside


def test_status_bytes_are_raw() -> None:
    """K9."""
    servo = fitted()
    assert servo.decode_status(b"\x01\x80" + bytes(6)) == {"status": 0x8001}
    assert servo.status == 0x8001


# Where it can be


@pytest.mark.parametrize(("raw", "jumped"), [(350, False), (351, True), (50, False), (49, True)])
def test_it_has_jumped_when_it_stands_where_nobody_sent_it(raw: int, jumped: bool) -> None:
    """K21: on the way from 10 to 30 degrees, and five more on each side, anything is possible."""
    servo = fitted()
    servo.enabled(100)
    servo.sent(300)
    servo.confirmed(300)
    servo.seen(raw)
    assert servo.jumped is jumped


def test_all_goals_since_the_last_reading_count() -> None:
    servo = fitted()
    servo.enabled(0)
    for raw in (300, -200, 100):
        servo.sent(raw)
        servo.confirmed(raw)
    found = []
    for raw in (290, 150, -100):
        servo.seen(raw)
        found.append(servo.jumped)
    assert found == [False, False, True]


def test_a_goal_that_may_have_been_obeyed_counts_as_well() -> None:
    servo = fitted()
    servo.enabled(0)
    servo.sent(500)
    servo.seen(480)
    assert not servo.jumped
    assert servo.setpoint is None


def test_enabling_forgets_the_jump_and_disabling_the_question() -> None:
    servo = fitted()
    servo.enabled(0)
    servo.seen(700)
    found = [servo.jumped]
    servo.enabled(700)
    found.append(servo.jumped)
    servo.disabled()
    servo.sent(300)
    servo.seen(0)
    assert [*found, servo.jumped] == [True, False, False]


def test_the_resting_place_is_the_last_goal_it_confirmed_else_where_it_was_seen() -> None:
    servo = fitted()
    places = [servo.resting_place]
    steps: list[tuple[Callable[[int], None], int]] = [
        (servo.seen, 120),
        (servo.enabled, 150),
        (servo.sent, 400),
        (servo.confirmed, 400),
        (servo.seen, 390),
        (servo.seen, 0),  # restarted: to send it back to its goal would move it
    ]
    for step, raw in steps:
        step(raw)
        places.append(servo.resting_place)
    assert places == [None, 120, 150, 150, 400, 400, 0]


def test_the_resting_place_is_inside_the_range() -> None:
    servo = fitted()
    servo.seen(940)
    assert servo.resting_place == 900
    servo.seen(-940)
    assert servo.resting_place == -900
