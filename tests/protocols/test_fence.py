"""The fence that every protocol shares: which reply key it chooses, and how often it tries."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from servobus.errors import DeviceError, ReplyTimeout
from servobus.protocols.base import Plan, Request, ask, run_plan
from servobus.protocols.fence import choose_key, fence
from tests.protocols.test_base import Number


def attempt(key: int) -> Plan[int]:
    return (yield from ask(Number(key)))


class Line:
    """Answers the requests of some keys, and keeps the keys that were asked."""

    def __init__(self, *answered: int, error: type[Exception] = ReplyTimeout) -> None:
        self.answered, self.error, self.asked = answered, error, list[int]()

    def exchange(self, request: Request[Any]) -> int:
        assert isinstance(request, Number)
        self.asked.append(request.number)
        if request.number in self.answered:
            return request.number
        raise self.error("no answer")


@pytest.mark.parametrize(
    ("avoid", "key"),
    [([], 3), ([3], 4), ([4, "another"], 3), ([(3, b""), 3, 4], 5), ([4, 3, 5], 4), (["another", 5, 3, 4, 5], 5)],
)
def test_the_first_free_key_is_chosen_else_the_oldest(avoid: Sequence[Any], key: int) -> None:
    assert choose_key(range(3, 6), avoid) == key


def test_a_fence_that_is_answered_is_sent_once() -> None:
    line = Line(4)
    assert run_plan(fence(attempt, range(3, 6), [3]), line.exchange) == 4
    assert line.asked == [4]


def test_the_second_fence_has_another_key() -> None:
    line = Line(5)
    assert run_plan(fence(attempt, range(3, 6), [], after_failure=[4]), line.exchange) == 5
    assert line.asked == [3, 5]


def test_the_error_of_the_second_fence_is_raised() -> None:
    line = Line()
    with pytest.raises(ReplyTimeout):
        run_plan(fence(attempt, range(3, 6), []), line.exchange)
    assert line.asked == [3, 4]


def test_other_errors_than_the_named_are_not_retried() -> None:
    line = Line(error=DeviceError)
    with pytest.raises(DeviceError):
        run_plan(fence(attempt, range(3, 6), [], retry_on=ReplyTimeout), line.exchange)
    assert line.asked == [3]
