"""Plans, and what every protocol's requests and lines have in common."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from servobus.errors import LinkDown, ReplyTimeout
from servobus.protocols.base import LineTraits, Plan, Request, ask, run_plan


class Number(Request[int]):
    """A question whose value is the number it was made with."""

    def __init__(self, number: int) -> None:
        self.node, self.nodes, self.frame, self.number = 1, (1,), bytes((number,)), number

    def answers(self, reply: object) -> bool:
        return reply == self.number

    def parse(self, replies: Sequence[Any]) -> int:
        return self.number


def numbered(request: Request[Any]) -> int:
    assert isinstance(request, Number)
    return request.number


def refusing(request: Request[Any]) -> int:
    raise ReplyTimeout(f"no answer to {numbered(request)}")


def total(*numbers: int) -> Plan[int]:
    result = 0
    for number in numbers:
        result += yield from ask(Number(number))
    return result


def test_a_plan_is_sent_what_its_requests_return() -> None:
    sent: list[int] = []

    def exchange(request: Request[Any]) -> int:
        sent.append(numbered(request))
        return 10 * numbered(request)

    assert run_plan(total(1, 2, 3), exchange) == 60
    assert sent == [1, 2, 3]


def test_a_plan_may_be_empty() -> None:
    assert run_plan(total(), refusing) == 0


def test_an_error_enters_the_plan_which_may_go_on() -> None:
    def careful() -> Plan[str]:
        try:
            yield from ask(Number(1))
        except ReplyTimeout as error:
            return f"{error}, then {(yield from total())}"
        return "answered"

    assert run_plan(careful(), refusing) == "no answer to 1, then 0"
    assert run_plan(careful(), numbered) == "answered"


def test_an_uncaught_error_ends_the_plan() -> None:
    with pytest.raises(ReplyTimeout, match="no answer to 1"):
        run_plan(total(1, 2), refusing)


def test_a_plan_may_send_more_after_an_error() -> None:
    sent: list[int] = []

    def tidy() -> Plan[int]:
        try:
            return (yield from total(1, 2))
        except LinkDown:
            yield from ask(Number(9))
            raise

    def exchange(request: Request[Any]) -> int:
        sent.append(numbered(request))
        if sent == [1, 2]:
            raise LinkDown("gone")
        return 0

    with pytest.raises(LinkDown, match="gone"):
        run_plan(tidy(), exchange)
    assert sent == [1, 2, 9]


def test_a_bug_in_the_exchange_does_not_enter_the_plan() -> None:
    def broken(request: Request[Any]) -> int:
        raise ZeroDivisionError

    def deaf() -> Plan[int]:
        try:
            return (yield from total(1))
        except Exception:  # noqa: BLE001 - it must not come here
            return -1

    with pytest.raises(ZeroDivisionError):
        run_plan(deaf(), broken)


def test_the_defaults_of_a_request() -> None:
    request = Number(1)
    assert (request.replies, request.idempotent, request.partial) == (1, True, False)
    assert (request.quiet_after, request.service_time) == (0.0, 0.0)
    assert request.plain() is None, "its echo cannot be an answer"


@pytest.mark.parametrize(("baudrate", "seconds"), [(1_000_000, 10e-6), (115_200, 10 / 115_200), (None, 0.0)])
def test_a_byte_takes_ten_bits(baudrate: int | None, seconds: float) -> None:
    assert LineTraits(baudrate).byte_time == pytest.approx(seconds)
