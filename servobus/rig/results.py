"""Waiting for several things at once, and for one that must not be cut short."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine, Mapping
from typing import Any

import anyio

from servobus.errors import PartialFailure, ServobusError
from servobus.values import Outcome


async def outcomes(futures: Mapping[str, asyncio.Future[Outcome]]) -> dict[str, Outcome]:
    """All of them, by name. Raises as `raise_failures`."""
    results = await asyncio.gather(*futures.values(), return_exceptions=True)
    named = dict(zip(futures, results, strict=True))
    raise_failures(named)
    return {name: result for name, result in named.items() if isinstance(result, Outcome)}


async def uncancelled(work: Coroutine[Any, Any, None]) -> asyncio.CancelledError | None:
    """Do it to its end, whoever cancels us meanwhile; returns the cancellation, to be raised when all is done."""
    task, cancelled = asyncio.ensure_future(work), None
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
    """One result raises its own error; several raise PartialFailure. What is no error of ours is raised as it is."""
    failures = [result for result in results.values() if isinstance(result, BaseException)]
    for failure in failures:
        if not isinstance(failure, ServobusError) or len(results) == 1:
            raise failure
    if failures:
        raise PartialFailure(results)
