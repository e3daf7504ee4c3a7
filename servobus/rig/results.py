"""Results of several servos, and a coroutine that must run to its end."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine, Mapping
from typing import Any

import anyio

from servobus.errors import PartialFailure, ServobusError
from servobus.values import Outcome


async def outcomes(futures: Mapping[str, asyncio.Future[Outcome]]) -> dict[str, Outcome]:
    """The outcomes of all, by name. Raises as `raise_failures`."""
    results = await asyncio.gather(*futures.values(), return_exceptions=True)
    named = dict(zip(futures, results, strict=True))
    raise_failures(named)
    return {name: result for name, result in named.items() if isinstance(result, Outcome)}


async def uncancelled(coroutine: Coroutine[Any, Any, None]) -> asyncio.CancelledError | None:
    """Run a coroutine to its end, even when the caller is cancelled. Returns that cancellation, to be raised later."""
    task, cancelled = asyncio.ensure_future(coroutine), None
    with anyio.CancelScope(shield=True):
        while not task.done():
            try:
                await asyncio.shield(task)
            except asyncio.CancelledError as error:
                if not task.done():
                    cancelled = error
    task.result()
    return cancelled


def raise_failures(results: Mapping[str, Any]) -> None:
    """Raise PartialFailure for several results, and the error itself for one result or for an error that is not of servobus."""
    failures = [result for result in results.values() if isinstance(result, BaseException)]
    for failure in failures:
        if not isinstance(failure, ServobusError) or len(results) == 1:
            raise failure
    if failures:
        raise PartialFailure(results)
