"""The same rigs for scripts and notebooks: every verb waits until it is done.

A thread of its own runs the client, so that leases are renewed while the script computes. A rig may be used from several threads.
Left by an exception, or with the process, the servos moved from here do their `on_lost_client`.
"""

from __future__ import annotations

import asyncio
import functools
import threading
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Collection, Coroutine, Generator, Iterator, Mapping
from concurrent.futures import CancelledError, Future
from contextlib import AbstractAsyncContextManager, suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Concatenate, Generic, ParamSpec, Self, TypeVar

from servobus.errors import LinkDown
from servobus.remote import rig as client
from servobus.rig.events import Event
from servobus.rig.interface import Rig, Servo
from servobus.values import Snapshot

if TYPE_CHECKING:
    from servobus.config.loader import Config

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")


class _Left(Exception):
    pass


class _Thread:
    """An event loop in a thread, and in it the context of one rig."""

    def __init__(self, rig: Callable[[], AbstractAsyncContextManager[Rig]]) -> None:
        self._ready: Future[Rig] = Future()
        self._failure: BaseException | None = None
        self._closing = threading.Lock()
        self._loop = asyncio.new_event_loop()
        self._leave: asyncio.Future[None] = self._loop.create_future()
        self._thread = threading.Thread(target=self._serve, args=(rig,), name="servobus", daemon=True)
        self._thread.start()
        try:
            self.rig = self._ready.result()
        except BaseException:  # it cannot be opened, or Ctrl-C came before it was
            with suppress(RuntimeError):  # it has ended already
                self._loop.call_soon_threadsafe(self._give_up)
            self._thread.join()
            raise

    def _serve(self, rig: Callable[[], AbstractAsyncContextManager[Rig]]) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._main(rig))

    def _give_up(self) -> None:
        for task in asyncio.all_tasks(self._loop):
            task.cancel()

    async def _main(self, rig: Callable[[], AbstractAsyncContextManager[Rig]]) -> None:
        try:
            async with rig() as opened:
                self._ready.set_result(opened)
                await self._leave
        except _Left:
            pass
        except BaseException as error:  # noqa: BLE001 - it is raised where the rig was wanted, or is left
            self._failure = error
            if not self._ready.done():
                self._ready.set_exception(error)

    def run(self, work: Coroutine[Any, Any, R]) -> R:
        """Do it in the loop. Ctrl-C ends the waiting, and the work with it."""
        if threading.current_thread() is self._thread:
            work.close()
            raise RuntimeError("a callback of this rig runs in its own thread, and may not wait for it: hand the work to another")
        if self._leave.done() or not self._thread.is_alive():
            work.close()
            raise LinkDown("this rig was left: nothing was sent")
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result()
        except CancelledError:
            raise LinkDown("this rig was left meanwhile: what was under way may have been applied") from None
        except BaseException:
            future.cancel()
            raise

    def close(self, *, lost: bool) -> None:
        if not self._closing.acquire(blocking=False):
            return  # it is left already
        self._loop.call_soon_threadsafe(self._end, lost)
        self._thread.join()
        if self._failure is not None:
            raise self._failure

    def _end(self, lost: bool) -> None:
        if lost:
            self._leave.set_exception(_Left())
        else:
            self._leave.set_result(None)


class _Blocking(Generic[T]):
    """Something whose verbs are awaited, for those who cannot."""

    def __init__(self, inner: T, thread: _Thread) -> None:
        self._inner = inner
        self._thread = thread


def _verb(verb: Callable[Concatenate[T, P], Coroutine[Any, Any, R]]) -> Callable[Concatenate[_Blocking[T], P], R]:
    @functools.wraps(verb)
    def wait(self: _Blocking[T], /, *args: P.args, **kwargs: P.kwargs) -> R:
        result: R = self._thread.run(getattr(self._inner, verb.__name__)(*args, **kwargs))
        return result

    return wait


class BlockingServo(_Blocking[Servo]):
    """One servo; the verbs of `servobus.Servo`."""

    @property
    def name(self) -> str:
        return self._inner.name

    def __repr__(self) -> str:
        return f"<BlockingServo {self.name}>"

    move_to = _verb(Servo.move_to)
    spin = _verb(Servo.spin)
    settle = _verb(Servo.settle)
    enable = _verb(Servo.enable)
    disable = _verb(Servo.disable)
    read = _verb(Servo.read)
    read_register = _verb(Servo.read_register)
    write_register = _verb(Servo.write_register)
    ping = _verb(Servo.ping)
    identify = _verb(Servo.identify)


class BlockingRig(_Blocking[Rig]):
    """A rig; the verbs of `servobus.Rig`. In use until `close`, or as a context."""

    move = _verb(Rig.move)
    send = _verb(Rig.send)
    send_all = _verb(Rig.send_all)
    enable = _verb(Rig.enable)
    disable = _verb(Rig.disable)
    stop = _verb(Rig.stop)
    clear = _verb(Rig.clear)
    settle = _verb(Rig.settle)
    read = _verb(Rig.read)
    read_register = _verb(Rig.read_register)
    write_register = _verb(Rig.write_register)
    ping = _verb(Rig.ping)
    identify = _verb(Rig.identify)
    scan = _verb(Rig.scan)
    set_id = _verb(Rig.set_id)
    set_baudrate = _verb(Rig.set_baudrate)
    command = _verb(Rig.command)
    acquire = _verb(Rig.acquire)
    release = _verb(Rig.release)
    reload = _verb(Rig.reload)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._thread.close(lost=kind is not None)

    def close(self) -> None:
        """As at the normal end of the context."""
        self._thread.close(lost=False)

    def __getitem__(self, name: str) -> BlockingServo:
        return BlockingServo(self._inner[name], self._thread)

    def __iter__(self) -> Iterator[BlockingServo]:
        return iter([BlockingServo(servo, self._thread) for servo in self._inner])

    @property
    def names(self) -> Mapping[str, tuple[str, str]]:
        return self._inner.names

    @property
    def stopped(self) -> bool:
        return self._inner.stopped

    def snapshot(self) -> Snapshot:
        return self._inside(self._inner.snapshot)

    def stats(self) -> dict[str, Any]:
        return self._inside(self._inner.stats)

    def _inside(self, look: Callable[[], R]) -> R:
        """In the rig's own thread, where nothing changes meanwhile."""

        async def inside() -> R:
            return look()

        return self._thread.run(inside())

    def watch(self, hz: float = 10.0) -> Generator[Snapshot, None, None]:
        """As `Rig.watch`, for a plain `for`."""
        return self._each(self._inner.watch(hz))

    def events(self) -> Generator[Event, None, None]:
        """As `Rig.events`, for a plain `for`."""
        return self._each(self._inner.events())

    def _each(self, items: AsyncIterator[R]) -> Generator[R, None, None]:
        async def following() -> R:
            return await anext(items)

        async def end() -> None:
            if isinstance(items, AsyncGenerator):
                await items.aclose()

        try:
            while True:
                try:
                    item = self._thread.run(following())
                except StopAsyncIteration:
                    return
                yield item
        finally:
            with suppress(LinkDown):
                self._thread.run(end())


def _waiting(rig: Callable[P, AbstractAsyncContextManager[Rig]]) -> Callable[P, BlockingRig]:
    @functools.wraps(rig)
    def wait(*args: P.args, **kwargs: P.kwargs) -> BlockingRig:
        thread = _Thread(lambda: rig(*args, **kwargs))
        return BlockingRig(thread.rig, thread)

    return wait


connect = _waiting(client.connect)


def open(config: str | Path | Config, *, buses: Collection[str] = (), degraded: bool = False) -> BlockingRig:
    """A rig whose ports this process owns: `servobus.open`."""
    from servobus.rig.local import open_rig  # the engine, which a client does without

    return _waiting(open_rig)(config, buses=buses, degraded=degraded)
