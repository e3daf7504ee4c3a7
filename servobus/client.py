"""RemoteRig: the rig of a running daemon, by its native door. A program cannot tell it from one of its own.

It connects again by itself when the daemon was away. What was under way then fails and is never repeated; while it is away calls
fail at once. A lease is renewed as long as this process runs, and given back when the context is left in order.
"""

from __future__ import annotations

import asyncio
import ssl
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import msgspec

from servobus.errors import LeaseHeld, LimitError, LinkDown
from servobus.events import Event
from servobus.protocols.words import Change, Goal, Identity, Outcome, State, StopReport, is_number
from servobus.rig import Found, Reload, Rig, Snapshot
from servobus.rpc.methods import Greeting
from servobus.rpc.place import find_socket, socket_path
from servobus.rpc.wire import Wire, open_wire
from servobus.session import PATIENCE, Session

REFRESH_HZ = 10.0
"""How often what `snapshot` answers is renewed."""
SCAN_PATIENCE = 3600.0


class RemoteRig(Rig):
    """Made by `servobus.connect`, and alive as long as that context."""

    def __init__(self, session: Session) -> None:
        self._session = session

    @property
    def greeting(self) -> Greeting:
        """What the daemon said of itself when it was last connected."""
        return self._session.greeting

    @property
    def names(self) -> Mapping[str, tuple[str, str]]:
        return self._session.greeting.names

    async def send_all(self, goals: Mapping[str, Goal], *, together: bool = False, confirm: bool = False) -> dict[str, Outcome]:
        full: dict[str, Goal] = {}
        for name, goal in goals.items():
            if self.full_name(name) in full:
                raise LimitError(f"{self.full_name(name)} is named twice: give it one goal; nothing was sent")
            _refuse(goal)
            full[self.full_name(name)] = goal
        if not full:
            return {}
        if again := self._session.lost & full.keys():  # this is a wish of now: it may be taken again
            await self.acquire(*again)
        try:
            result: dict[str, Outcome] = await self._session.call("send_all", goals=full, together=together, confirm=confirm)
        except LeaseHeld:
            self._session.lost |= full.keys()  # if it had expired, the next wish asks for it anew
            raise
        finally:
            if self._session.wire is not None:
                self._session.held |= full.keys() - self._session.lost
        return result

    async def enable(self, *names: str) -> None:
        await self._session.call("enable", names=self.full_names(names))

    async def disable(self, *names: str) -> None:
        await self._session.call("disable", names=self.full_names(names))

    async def stop(self) -> dict[str, StopReport]:
        reports: dict[str, StopReport] = await self._session.call("stop")
        self._session.stopped = True
        return reports

    async def clear(self) -> None:
        await self._session.call("clear")
        self._session.stopped = False

    @property
    def stopped(self) -> bool:
        """As of the last news, which are at most a refresh old."""
        return self._session.stopped

    async def settle(self, *names: str, tolerance: float | None = None, timeout: float = 10.0) -> Snapshot:
        found: Snapshot = await self._session.call(
            "settle", PATIENCE + timeout, names=self.full_names(names), tolerance=tolerance, timeout=timeout
        )
        return found

    async def read(self, name: str, *, max_age: float | None = None) -> State:
        state: State = await self._session.call("read", name=self.full_name(name), max_age=max_age)
        return state

    def snapshot(self) -> Snapshot:
        """As of the last refresh."""
        return dict(self._session.known)

    async def watch(self, hz: float = 10.0) -> AsyncIterator[Snapshot]:
        if not 0 < hz <= 1000:
            raise ValueError(f"watch: {hz} Hz is outside 0 to 1000")
        yield self.snapshot()
        news: asyncio.Queue[Snapshot] = asyncio.Queue(1)

        def put(params: Any) -> None:
            if news.full():
                news.get_nowait()  # the latest wins
            news.put_nowait(msgspec.convert(params["states"], Snapshot))

        wire, number = None, 0
        try:
            while True:
                if wire is not self._session.wire and self._session.wire is not None:  # the first time, and after it was away
                    wire = self._session.wire
                    with suppress(LinkDown):
                        number = await self._session.ask("subscribe", {"topic": "state", "hz": min(max(hz, 0.1), 200.0)}, int)
                        self._session.watchers[number] = put
                with suppress(TimeoutError):
                    async with asyncio.timeout(1.0):
                        yield await news.get()
        finally:
            self._session.watchers.pop(number, None)
            if wire is not None and wire is self._session.wire:
                wire.tell("unsubscribe", {"subscription": number})

    def events(self) -> AsyncIterator[Event]:
        return self._session.announcer.events()

    async def read_register(self, name: str, register: str, *, raw: bool = False) -> Any:
        return await self._session.call("read_register", name=self.full_name(name), register=register, raw=raw)

    async def write_register(self, name: str, register: str, value: Any, *, raw: bool = False, persist: bool = False) -> Any:
        if isinstance(value, float) and not is_number(value):
            raise LimitError(f"{value} is no finite number: nothing was sent")
        full = self.full_name(name)
        return await self._session.call("write_register", name=full, register=register, value=value, raw=raw, persist=persist)

    async def ping(self, name: str) -> int | None:
        status: int | None = await self._session.call("ping", name=self.full_name(name))
        return status

    async def identify(self, name: str) -> Identity:
        identity: Identity = await self._session.call("identify", name=self.full_name(name))
        return identity

    async def scan(
        self,
        bus: str,
        *,
        baudrates: Iterable[int] = (),
        ids: Iterable[int] = (),
        progress: Callable[[int, int, Found | None], None] | None = None,
    ) -> list[Found]:
        if progress is not None:
            self._session.progress[bus] = progress
        try:
            keys = {"baudrates": list(baudrates), "ids": list(ids), "progress": progress is not None}
            found: list[Found] = await self._session.call("scan", SCAN_PATIENCE, bus=bus, **keys)
            return found
        finally:
            self._session.progress.pop(bus, None)

    async def set_id(self, bus: str, node: int, new: int, *, save: bool = False) -> Change:
        change: Change = await self._session.call("set_id", 3 * PATIENCE, bus=bus, node=node, new=new, save=save)
        return change

    async def set_baudrate(self, bus: str, node: int, baudrate: int, *, save: bool = False) -> Change:
        change: Change = await self._session.call("set_baudrate", 3 * PATIENCE, bus=bus, node=node, baudrate=baudrate, save=save)
        return change

    async def command(self, bus: str, node: int, name: str, value: int | None = None) -> tuple[str, ...]:
        told: tuple[str, ...] = await self._session.call("command", 3 * PATIENCE, bus=bus, node=node, name=name, value=value)
        return told

    def stats(self) -> dict[str, Any]:
        """At most a second old, from the first call on."""
        if not self._session.stats_wanted and self._session.wire is not None:
            self._session.stats_wanted = True
            self._session.task(self._quietly(self._session.follow_stats()))
        return self._session.stats

    @staticmethod
    async def _quietly(work: Any) -> None:
        with suppress(LinkDown):
            await work

    async def config(self) -> dict[str, Any]:
        """The daemon's buses, as plain data."""
        found: dict[str, Any] = await self._session.call("config")
        return found

    async def acquire(self, *names: str) -> None:
        full = self.full_names(names)
        await self._session.call("acquire", names=full)
        self._session.lost -= set(full)
        self._session.held |= set(full)

    async def release(self, *names: str) -> None:
        full = self.full_names(names)
        self._session.held -= set(full)
        await self._session.call("release", names=full)

    async def reload(self) -> Reload:
        report: Reload = await self._session.call("reload", 3 * PATIENCE)
        await self._session.rename()
        return report


def _refuse(goal: Goal) -> None:
    """What JSON cannot carry, in the words of every rig."""
    for key in ("value", "speed", "duration", "acceleration", "effort", "deadline"):
        value = getattr(goal, key)
        if value is not None and not is_number(value):
            raise LimitError(f"{goal.kind if key == 'value' else key} {value!r} is not a finite number: nothing was sent")


@asynccontextmanager
async def connect(
    address: str | Path | None = None,
    *,
    name: str = "",
    token: str | None = None,
    tls: ssl.SSLContext | None = None,
    refresh_hz: float = REFRESH_HZ,
) -> AsyncIterator[RemoteRig]:
    """The rig of a running daemon. `address`: its socket, or `tcp://host:port` with a `token`, and `tls` where it is not this
    machine; None: where a daemon of this machine has it. `name`: what others are told of who moves a servo. Left in order, what
    moves goes on; left by an error, its servos do their `on_lost_client`.
    Raises LinkDown, AccessDenied, NotSupported."""
    target = str(find_socket() or socket_path()) if address is None else str(address)

    async def dial() -> Wire:
        return await open_wire(target, tls)

    session = Session(dial, name, token, refresh_hz)
    await session.open()
    try:
        yield RemoteRig(session)
    except BaseException:
        await session.close(release=False)
        raise
    await session.close(release=True)
