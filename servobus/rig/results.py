"""Results of several servos, and a coroutine that must run to its end."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine, Iterable, Mapping
from typing import Any

import anyio

from servobus.errors import PartialFailure, ServobusError
from servobus.values import Outcome


async def outcomes(futures: Mapping[str, asyncio.Future[Outcome]]) -> dict[str, Outcome]:
    """Wait for all futures and return their outcomes by name. Raises as `raise_failures`.

    A caller that is cancelled cancels every goal that still waits.
    """
    done: dict[str, Outcome] = {}
    failures: dict[str, Exception] = {}
    try:
        # Goals of one frame end together, so this waits for the first of them and is woken up once.
        for name, future in futures.items():
            try:
                done[name] = await future
            except Exception as error:  # noqa: BLE001 - it is raised below, with those of the other servos
                failures[name] = error
    except asyncio.CancelledError:
        _abandon(futures.values())
        raise
    if failures:
        raise_failures({name: failures.get(name) or done[name] for name in futures})
    return done


def _abandon(futures: Iterable[asyncio.Future[Outcome]]) -> None:
    """Cancel the futures that have not ended, and mark the errors of the others as received."""
    for future in futures:
        if not future.cancel() and not future.cancelled():
            future.exception()


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
