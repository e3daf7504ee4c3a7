"""How the results of several goals become one."""

from __future__ import annotations

import asyncio

import pytest

from servobus.errors import NotEnabled, PartialFailure, ReplyTimeout
from servobus.rig.results import outcomes
from servobus.values import Outcome
from tests.virtual_time import virtual


def futures() -> tuple[asyncio.Future[Outcome], asyncio.Future[Outcome], asyncio.Future[Outcome]]:
    loop = asyncio.get_running_loop()
    return loop.create_future(), loop.create_future(), loop.create_future()


def named(each: tuple[asyncio.Future[Outcome], ...]) -> dict[str, asyncio.Future[Outcome]]:
    return dict(zip("abc", each, strict=True))


@virtual
async def test_outcomes_keep_their_order_whichever_ends_first() -> None:
    first, second, third = every = futures()
    waiting = asyncio.create_task(outcomes(named(every)))
    await asyncio.sleep(0)
    third.set_result(Outcome.SENT)
    second.set_result(Outcome.ACKED)
    await asyncio.sleep(0)
    assert not waiting.done()
    first.set_result(Outcome.SUPERSEDED)
    result = await waiting
    assert list(result.items()) == [("a", Outcome.SUPERSEDED), ("b", Outcome.ACKED), ("c", Outcome.SENT)]


@virtual
async def test_a_failure_waits_for_the_other_goals_and_names_all() -> None:
    first, second, third = every = futures()
    waiting = asyncio.create_task(outcomes(named(every)))
    error = NotEnabled("off")
    first.set_exception(error)
    second.set_result(Outcome.SENT)
    await asyncio.sleep(0)
    assert not waiting.done()
    third.set_result(Outcome.ACKED)
    with pytest.raises(PartialFailure) as raised:
        await waiting
    assert list(raised.value.results.items()) == [("a", error), ("b", Outcome.SENT), ("c", Outcome.ACKED)]


@virtual
async def test_an_error_that_is_not_of_servobus_is_raised_itself() -> None:
    first, second, third = every = futures()
    first.set_exception(ReplyTimeout("silent"))
    second.set_exception(ZeroDivisionError())
    third.set_result(Outcome.SENT)
    with pytest.raises(ZeroDivisionError):
        await outcomes(named(every))


@virtual
async def test_a_caller_who_leaves_cancels_every_goal_that_waits() -> None:
    """An error that ended a goal before is not reported as forgotten."""
    forgotten: list[object] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: forgotten.append(context))
    first, second, third = every = futures()
    waiting = asyncio.create_task(outcomes(named(every)))
    await asyncio.sleep(0)
    second.set_exception(ReplyTimeout("silent"))
    waiting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await waiting
    assert first.cancelled()
    assert third.cancelled()
    del first, second, third, every, waiting
    assert forgotten == []
