"""How a command runs its coroutine: on uvloop where it is installed, and ended in order by a signal."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Callable, Coroutine, Sequence
from contextlib import suppress
from types import FrameType
from typing import Any, TypeVar

from servobus.cli.ending import INTERRUPTED, TERMINATED, of_command

R = TypeVar("R")
SIGNALS = (signal.SIGTERM, signal.SIGHUP)


def run(
    main: Callable[[], Coroutine[Any, Any, R]], *, terminated: int = TERMINATED, signals: Sequence[signal.Signals] = SIGNALS
) -> R:
    """Run a coroutine in an event loop of its own.

    Ctrl-C and each of `signals` cancel it, so that exit policies are applied; what is done then is said at once. A second one
    says what is left energised, and ends the process at once, with 130 after Ctrl-C and 143 otherwise; so it does until the
    process ends, also when the coroutine has ended. After one of `signals` the exit status is `terminated`, after Ctrl-C 130.
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
    task, loop, ending = asyncio.current_task(), asyncio.get_running_loop(), of_command()
    assert task is not None
    received: list[int] = []

    def interrupt() -> None:
        task.cancel()
        ending.interrupted()

    def handle(number: int, _: FrameType | None) -> None:
        received.append(number)
        if len(received) == 1:
            loop.call_soon_threadsafe(interrupt)
            return
        try:  # the loop may be blocked, so this is done in the handler
            ending.abandoned()
        finally:
            os._exit(INTERRUPTED if number == signal.SIGINT else TERMINATED)

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, *signals)}
    try:
        return await main()
    except asyncio.CancelledError:
        if not received:
            raise
        raise (KeyboardInterrupt() if received[0] == signal.SIGINT else SystemExit(status)) from None
    finally:
        if not received:
            for number, handler in before.items():
                signal.signal(number, handler)
