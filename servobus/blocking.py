"""The same rigs for scripts and notebooks: every verb waits until it is done.

The rig lives in the event loop of a thread of its own (anyio's BlockingPortal), so that leases are renewed while the script
computes. It may be used from several threads. A rig that is still in use when the process ends is left as by an exception: the
servos moved from here do their `on_lost_client`, those of a rig of its own their `on_exit`.
"""

from __future__ import annotations

import atexit
import functools
import threading
from collections.abc import AsyncIterator, Callable, Collection, Generator, Iterator, Mapping
from concurrent.futures import CancelledError
from contextlib import AbstractAsyncContextManager, ExitStack, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, ParamSpec, Self, TypeVar

from anyio.from_thread import start_blocking_portal

from servobus.errors import LinkDown
from servobus.remote import rig as remote
from servobus.rig.blocking_verbs import RigVerbs, ServoVerbs
from servobus.rig.events import Event
from servobus.rig.interface import Rig, Servo
from servobus.values import Snapshot

P = ParamSpec("P")
R = TypeVar("R")
_in_use: set[_Thread] = set()
"""Left at the end of the process, while threads still run: a portal that is closed later waits for ever."""


class _Thread:
    """An event loop in a thread, and in it the context of one rig."""

    def __init__(self, context: AbstractAsyncContextManager[Rig]) -> None:
        self._closing = threading.Lock()
        with ExitStack() as stack:
            self._portal = stack.enter_context(start_blocking_portal(name="servobus"))
            self._ident = self._portal.call(threading.get_ident)
            stack.callback(self._portal.call, self._portal.stop, True)  # ends what other threads wait for
            self.rig = stack.enter_context(self._portal.wrap_async_context_manager(context))
            self._contexts = stack.pop_all()
        _in_use.add(self)

    def wait(self, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """Call a function in the loop and wait for its result. Ctrl-C ends the waiting, and the call with it."""
        if threading.get_ident() == self._ident:
            raise RuntimeError("a callback of this rig runs in its own thread and may not wait for it: use another thread")
        try:
            future = self._portal.start_task_soon(functools.partial(function, *args, **kwargs))
        except RuntimeError:
            raise LinkDown("this rig was left: nothing was sent") from None
        try:
            return future.result()
        except CancelledError:
            raise LinkDown("this rig was left meanwhile: what was under way may have been applied") from None
        except BaseException:
            future.cancel()
            raise

    def close(
        self, kind: type[BaseException] | None = None, error: BaseException | None = None, trace: TracebackType | None = None
    ) -> None:
        if self._closing.acquire(blocking=False):  # else it is left already
            _in_use.discard(self)
            self._contexts.__exit__(kind, error, trace)


@atexit.register
def _leave_all() -> None:
    for thread in tuple(_in_use):
        with suppress(Exception):  # nobody is left to see it
            thread.close(SystemExit, SystemExit())


class BlockingServo(ServoVerbs):
    """One servo: the verbs of `servobus.Servo`, each of which waits until it is done."""

    def __init__(self, inner: Servo, thread: _Thread) -> None:
        self.inner = inner
        self.wait = thread.wait

    @property
    def name(self) -> str:
        """Its full name, "bus/servo"."""
        return self.inner.name

    def __repr__(self) -> str:
        return f"<BlockingServo {self.name}>"


class BlockingRig(RigVerbs):
    """A rig: the verbs of `servobus.Rig`, each of which waits until it is done. In use until `close`, or as a context."""

    def __init__(self, thread: _Thread) -> None:
        self.inner = thread.rig
        self.wait = thread.wait
        self._thread = thread

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._thread.close(kind, error, trace)

    def close(self) -> None:
        """Leave the rig, as at the normal end of its context. A second call does nothing."""
        self._thread.close()

    def __getitem__(self, name: str) -> BlockingServo:
        return BlockingServo(self.inner[name], self._thread)

    def __iter__(self) -> Iterator[BlockingServo]:
        return iter([BlockingServo(servo, self._thread) for servo in self.inner])

    @property
    def names(self) -> Mapping[str, tuple[str, str]]:
        """Full name -> (bus, servo), in the order of the config."""
        return self.inner.names

    @property
    def stopped(self) -> bool:
        """Whether the e-stop is latched."""
        return self.inner.stopped

    def snapshot(self) -> Snapshot:
        """Return the last known state of every servo, without a turn."""
        states: Snapshot = self.wait(self.inner.snapshot)
        return states

    def stats(self) -> dict[str, Any]:
        """Return counters and latencies, by bus: see `Rig.stats`."""
        stats: dict[str, Any] = self.wait(self.inner.stats)
        return stats

    def watch(self, hz: float = 10.0) -> Generator[Snapshot, None, None]:
        """Yield snapshots `hz` times a second: see `Rig.watch`."""
        return self._each(self.inner.watch(hz))

    def events(self) -> Generator[Event, None, None]:
        """Yield what happens from this call on: see `Rig.events`."""
        return self._each(self.wait(self.inner.events))

    def _each(self, items: AsyncIterator[R]) -> Generator[R, None, None]:
        try:
            while True:
                try:
                    item: R = self.wait(anext, items)
                except StopAsyncIteration:
                    return
                yield item
        finally:
            with suppress(LinkDown):
                self.wait(items.aclose)  # type: ignore[attr-defined]


def _blocking(make: Callable[P, AbstractAsyncContextManager[Rig]]) -> Callable[P, BlockingRig]:
    @functools.wraps(make)
    def call(*args: P.args, **kwargs: P.kwargs) -> BlockingRig:
        return BlockingRig(_Thread(make(*args, **kwargs)))

    return call


connect = _blocking(remote.connect)


def open(config: Any, *, buses: Collection[str] = (), degraded: bool = False) -> BlockingRig:
    """Own the ports of a config until the rig is closed; then each servo enabled here is left as its `on_exit` says.

    Args:
        config: Path of the YAML file (str or Path), or a loaded Config.
        buses: Names of the buses to open; none: all.
        degraded: True: a port that cannot be opened is waited for; False: it raises.

    Raises: ConfigError, PortMissing, PortBusy, PortDenied, LinkDown.
    """
    from servobus.rig.local import open_rig  # the engine, which a client of a daemon does not need

    return _blocking(open_rig)(Path(config) if isinstance(config, str) else config, buses=buses, degraded=degraded)
