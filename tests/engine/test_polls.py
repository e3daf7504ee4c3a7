"""Polls on fixed grids: late ones shift nothing, and those that were missed are counted."""

from __future__ import annotations

import math

import pytest

from servobus.engine.polls import PollGrid
from tests.engine.toy_protocol import poll


def test_without_polls_nothing_is_ever_due() -> None:
    grid = PollGrid()
    assert (grid.due, grid.take(1e9), grid.missed) == (math.inf, None, 0)


def test_polls_of_one_rate_are_spread_over_their_period() -> None:
    grid = PollGrid()
    grid.set([poll("a", 10, 1), poll("b", 10, 2)], 5.0)
    taken = []
    for now in (5.0, 5.049, 5.05, 5.099, 5.1):
        due = grid.take(now)
        taken.append(due and due.name)
    assert taken == ["a", None, "b", None, "a"]


@pytest.mark.parametrize(("late", "missed"), [(0.0, 0), (0.09, 0), (0.1, 1), (0.19, 1), (0.35, 3)])
def test_a_late_poll_shifts_nothing(late: float, missed: int) -> None:
    grid = PollGrid()
    grid.set([poll("a", 10, 1)], 0.0)
    assert grid.take(late) is not None
    assert grid.missed == missed
    assert grid.due == pytest.approx((missed + 1) / 10)


def test_the_longest_due_goes_first() -> None:
    grid = PollGrid()
    grid.set([poll("slow", 1, 1), poll("fast", 100, 2)], 0.0)
    names = []
    while (due := grid.take(0.5)) is not None:
        names.append(due.name)
    assert names[0] == "slow"
    assert "fast" in names
    assert grid.due > 0.5
