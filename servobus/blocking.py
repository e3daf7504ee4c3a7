"""The same rig for scripts and notebooks: every verb blocks until it is done.

    with servobus.blocking.connect() as rig:
        rig.enable()
        rig["elbow"].move_to(30)

The client runs on a loop in a thread of its own, so a lease is renewed while the script computes, sleeps or waits for a key.
Verbs, their arguments and their errors are those of `servobus.Rig` and `servobus.Servo`; any thread may call them.
"""

from __future__ import annotations

import asyncio
import functools
import inspect
import threading
from collections.abc import Callable, Coroutine, Iterator
from contextlib import AbstractAsyncContextManager, contextmanager
from pathlib import Path
from typing import Any, TypeVar

from servobus import client, opening
from servobus import rig as interface

T = TypeVar("T")


class _Loop:
    """A loop in a thread."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="servobus", daemon=True)
        self._thread.start()

    def wait(self, work: Coroutine[Any, Any, T]) -> T:
        """Its result. An interrupt here cancels it there."""
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result()
        except BaseException:
            future.cancel()
            raise

    def call(self, function: Callable[..., T], *arguments: Any, **keys: Any) -> T:
        """A plain function, on the loop's own thread."""

        async def run() -> T:
            return function(*arguments, **keys)

        return self.wait(run())

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()


class _Blocking:
    """Anything of the interface, with its coroutines made to block."""

    def __init__(self, loop: _Loop, inner: Any) -> None:
        self._loop = loop
        self._inner = inner

    def __repr__(self) -> str:
        return f"<blocking {self._inner!r}>"

    def __dir__(self) -> list[str]:
        return [name for name in dir(self._inner) if not name.startswith("_")]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        found = getattr(self._inner, name)
        if not callable(found):
            return found

        @functools.wraps(found)
        def verb(*arguments: Any, **keys: Any) -> Any:
            result = self._loop.call(found, *arguments, **keys)
            if inspect.isawaitable(result):
                return self._loop.wait(_awaited(result))
            return self._iterate(result) if hasattr(result, "__anext__") else result

        return verb

    def _iterate(self, items: Any) -> Iterator[Any]:
        try:
            while True:
                try:
                    item = self._loop.wait(anext(items))
                except StopAsyncIteration:
                    return
                yield item
        finally:
            self._loop.wait(items.aclose())


async def _awaited(result: Any) -> Any:
    return await result


class Servo(_Blocking):
    """See `servobus.Servo`."""


class Rig(_Blocking):
    """See `servobus.Rig`."""

    def __getitem__(self, name: str) -> Servo:
        return Servo(self._loop, self._inner[name])

    def __iter__(self) -> Iterator[Servo]:
        return iter([Servo(self._loop, servo) for servo in self._inner])


@contextmanager
def _entered(make: Callable[[], AbstractAsyncContextManager[interface.Rig]]) -> Iterator[Rig]:
    loop = _Loop()
    try:
        context = loop.call(make)
        inner = loop.wait(_awaited(context.__aenter__()))
        try:
            yield Rig(loop, inner)
        except BaseException as error:
            if not loop.wait(_awaited(context.__aexit__(type(error), error, error.__traceback__))):
                raise
        else:
            loop.wait(_awaited(context.__aexit__(None, None, None)))
    finally:
        loop.close()


def connect(address: str | Path | None = None, **keys: Any) -> Any:
    """As `servobus.connect`: the rig of a running daemon. Left by an error, its servos do their `on_lost_client`."""
    return _entered(lambda: client.connect(address, **keys))


def open(config: str | Path, **keys: Any) -> Any:
    """As `servobus.open`: the ports belong to this process."""
    return _entered(lambda: opening.open_rig(config, **keys))
