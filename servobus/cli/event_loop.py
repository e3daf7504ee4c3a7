"""How a command runs its coroutine: on uvloop where it is installed, and ended in order by a signal."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Callable, Coroutine, Sequence
from contextlib import suppress
from typing import Any, TypeVar

R = TypeVar("R")
TERMINATED = 128 + signal.SIGTERM
SIGNALS = (signal.SIGTERM, signal.SIGHUP)


def run(
    main: Callable[[], Coroutine[Any, Any, R]], *, terminated: int = TERMINATED, signals: Sequence[signal.Signals] = SIGNALS
) -> R:
    """Run a coroutine in an event loop of its own.

    Ctrl-C and each of `signals` cancel it, so that exit policies are applied. A second one of `signals` ends the process at once.
    The exit status after one of `signals` is `terminated`; after Ctrl-C it is 130.
    """
    with asyncio.Runner(loop_factory=loop_factory()) as runner:
        return runner.run(_until_signalled(main, terminated, signals))


def loop_factory() -> Callable[[], asyncio.AbstractEventLoop] | None:
    """uvloop's factory where uvloop is installed; None: asyncio's own."""
    with suppress(ImportError):
        import uvloop

        return uvloop.new_event_loop
    return None


async def _until_signalled(main: Callable[[], Coroutine[Any, Any, R]], status: int, signals: Sequence[signal.Signals]) -> R:
    task, loop = asyncio.current_task(), asyncio.get_running_loop()
    assert task is not None
    received: list[int] = []

    def terminate() -> None:
        if received:
            os._exit(status)
        received.append(status)
        task.cancel()

    for number in signals:
        loop.add_signal_handler(number, terminate)
    try:
        return await main()
    except asyncio.CancelledError:
        if received:
            raise SystemExit(status) from None
        raise
    finally:
        for number in signals:
            loop.remove_signal_handler(number)
