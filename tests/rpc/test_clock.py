"""The age of a call by its caller's clock: one that is shared, and one of another machine."""

from __future__ import annotations

import random

from servobus.rpc.clock import DRIFT, CallerClock, machine


def test_the_clock_of_this_machine_is_shared() -> None:
    clock = CallerClock()
    clock.greet(machine())
    assert clock.age(100.0, 103.0) == 3.0
    assert clock.age(103.5, 103.0) == 0.0, "a clock that was read a moment later"
    assert clock.age(None, 103.0) == 0.0


def test_the_smallest_difference_is_the_offset_of_another_machine() -> None:
    for name in ("", "another machine"):
        clock = CallerClock()
        clock.greet(name)
        assert clock.age(5000.0, 10.0) == 0.0, "nothing is known yet"
        assert clock.age(5001.0, 11.2) < 0.21
        assert clock.age(5001.0, 11.2) > 0.19
        assert clock.age(5003.0, 12.95) == 0.0, "a shorter way"
        assert 2.9 < clock.age(5005.0, 17.95) < 3.1


def test_a_drift_makes_no_prompt_call_old() -> None:
    """A day at 50 ppm, on ways of 1 to 3 ms; a call that waits for a second is found nevertheless."""
    numbers, clock, asked = random.Random(1), CallerClock(), 0.0
    for _ in range(86_400):
        asked += 1.0
        way = 0.001 + 0.002 * numbers.random()
        assert clock.age(asked * (1 - DRIFT / 2), asked + way) < 0.01
    assert clock.age((asked - 1.0) * (1 - DRIFT / 2), asked) > 0.9
