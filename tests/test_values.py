"""Goals, calibrations and changes: the words that mean the same in every protocol."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobus.values import Calibration, Change, Described, EventName, is_number

PLAIN = Calibration(zero=2048, direction=1, unit_per_step=0.5)
TURNED = Calibration(zero=100, direction=-1, unit_per_step=0.25)


@pytest.mark.parametrize(
    ("calibration", "raw", "position"),
    [(PLAIN, 2048, 0.0), (PLAIN, 2050, 1.0), (PLAIN, 0, -1024.0), (TURNED, 100, 0.0), (TURNED, 104, -1.0), (TURNED, 96, 1.0)],
)
def test_steps_and_positions(calibration: Calibration, raw: int, position: float) -> None:
    assert calibration.to_unit(raw) == position
    assert calibration.to_raw(position) == raw


@pytest.mark.parametrize(
    ("position", "raw"), [(0.25, 2048), (0.75, 2050), (-0.25, 2048), (-0.75, 2046), (0.26, 2049), (0.24, 2048)]
)
def test_the_nearest_step_and_ties_to_even(position: float, raw: int) -> None:
    assert PLAIN.to_raw(position) == raw


def test_rates_have_a_direction() -> None:
    assert (PLAIN.rate_to_unit(10), TURNED.rate_to_unit(10)) == (5.0, -2.5)
    assert (PLAIN.rate_to_raw(5), TURNED.rate_to_raw(-2.5)) == (10.0, 10.0)


def test_zero_has_no_sign() -> None:
    assert math.copysign(1, TURNED.to_unit(100)) == 1
    assert math.copysign(1, TURNED.rate_to_unit(0)) == 1


@given(st.integers(-32767, 32767), st.sampled_from([1, -1]), st.floats(0.001, 10), st.floats(-5000, 5000))
def test_there_and_back(raw: int, direction: int, unit_per_step: float, zero: float) -> None:
    calibration = Calibration(zero, direction, unit_per_step)
    assert calibration.to_raw(calibration.to_unit(raw)) == raw


@pytest.mark.parametrize(
    ("value", "number"),
    [
        (0, True),
        (-1.5, True),
        (1e308, True),
        (10**300, True),
        (10**400, False),
        (math.nan, False),
        (math.inf, False),
        (-math.inf, False),
        (True, False),
        ("1", False),
        (None, False),
        (1j, False),
    ],
    ids=lambda value: str(value)[:12],
)
def test_what_is_a_number(value: object, number: bool) -> None:
    assert is_number(value) is number


@pytest.mark.parametrize(("saved", "step"), [(False, "save and restart the servo"), (True, "restart the servo")])
def test_a_change_says_what_is_still_to_do(saved: bool, step: str) -> None:
    assert str(Change(1, "id", 5, saved=saved)) == f"pending_reboot: id 5 is set and not in effect yet: {step}"


class Fruit(Described):
    APPLE = "apple", "It keeps all winter."


def test_a_described_enum_is_a_string_with_a_sentence() -> None:
    assert Fruit("apple") is Fruit.APPLE
    assert (f"{Fruit.APPLE}", Fruit.APPLE.description) == ("apple", "It keeps all winter.")


def test_every_event_says_what_it_means() -> None:
    for event in EventName:
        assert event == event.name.lower()
        assert event.description.endswith((".", ")."))
        assert all(field.isidentifier() for field in event.fields)
