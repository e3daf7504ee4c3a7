"""Session: a client's standing connection to a daemon. It connects again, renews what it holds, and keeps what it is told."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from typing import Any

import msgspec

from servobus.errors import LinkDown
from servobus.events import Announcer, Event
from servobus.rig import Found, Snapshot
from servobus.rpc.methods import METHODS, PROTOCOL, Greeting
from servobus.rpc.wire import Wire

STATS_HZ = 1.0
FIRST_PAUSE, LAST_PAUSE = 0.05, 2.0
"""Seconds between two attempts to connect again."""
PATIENCE = 10.0
"""Seconds for an answer, beside what the call itself may take."""


class Session:
    """What a RemoteRig stands on."""

    def __init__(self, dial: Callable[[], Awaitable[Wire]], client: str, token: str | None, refresh_hz: float) -> None:
        self._dial = dial
        self._hello = {"client": client, "token": token, "protocol": PROTOCOL}
        self._refresh_hz = refresh_hz
        self.wire: Wire | None = None
        self._why = "it is connecting"
        self.known: Snapshot = {}
        self.stopped = False
        self.stats: dict[str, Any] = {}
        self.stats_wanted = False
        self.held: set[str] = set()
        self.lost: set[str] = set()
        self.announcer = Announcer()
        self.watchers: dict[int, Callable[[Any], None]] = {}
        self.progress: dict[str, Callable[[int, int, Found | None], None]] = {}
        self._tasks: set[asyncio.Task[Any]] = set()
        self.greeting: Greeting
        """What the daemon said of itself when it was last connected."""

    # The connection

    async def open(self) -> None:
        """The first time; its failure is the caller's. Raises LinkDown, AccessDenied, NotSupported."""
        await self._connect()
        self.task(self._keep())
        self.task(self._renew())

    async def _connect(self) -> None:
        wire = await self._dial()
        try:
            greeting = msgspec.convert(await wire.call("hello", self._hello, PATIENCE), Greeting)
            wire.on_notification = self._notified
            self.wire = wire
            self.greeting = greeting
            self.stopped = greeting.stopped
            self.held.clear()
            self.known = await self.ask("snapshot", {}, Snapshot)
            self.stats = await self.ask("stats", {}, dict[str, Any])
            await self._subscribe_own()
        except msgspec.ValidationError:
            wire.close()
            raise LinkDown("who listens there does not speak as a servobus daemon does: check the address") from None
        except BaseException:
            wire.close()
            self.wire = None
            raise

    async def _subscribe_own(self) -> None:
        self.watchers.clear()
        own = await self.ask("subscribe", {"topic": "state", "hz": self._refresh_hz}, int)
        self.watchers[own] = self._refreshed
        events = await self.ask("subscribe", {"topic": "events"}, int)
        self.watchers[events] = self._told
        if self.stats_wanted:
            await self.follow_stats()

    async def follow_stats(self) -> None:
        number = await self.ask("subscribe", {"topic": "stats", "hz": STATS_HZ}, int)
        self.watchers[number] = self._counted

    async def _keep(self) -> None:
        """Connect again whenever it is gone."""
        while True:
            assert self.wire is not None
            self._why = await self.wire.closed
            self.wire = None
            pause = FIRST_PAUSE
            while self.wire is None:
                await asyncio.sleep(pause)
                pause = min(2 * pause, LAST_PAUSE)
                try:
                    await self._connect()
                except Exception as error:  # noqa: BLE001 - whatever it is, it is tried again; calls say why they fail
                    self._why = str(error)

    async def _renew(self) -> None:
        while True:
            await asyncio.sleep(self.greeting.lease_ms / 3000)
            if self.held:
                with suppress(LinkDown):
                    await self.ask("renew", {}, Any)

    async def close(self, *, release: bool) -> None:
        """With `release` what moves goes on to its goal; without, the daemon does what it does when a client is lost."""
        if release and self.held:
            with suppress(LinkDown):
                await self.ask("release", {}, None)
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        if self.wire is not None:
            await self.wire.wait_closed()

    def task(self, work: Any) -> None:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    # What it says unasked

    def _notified(self, method: str, params: Any) -> None:
        if method == "progress":
            progress = self.progress.get(params["bus"])
            if progress is not None:
                found = params["found"]
                progress(params["asked"], params["total"], None if found is None else msgspec.convert(found, Found))
            return
        watcher = self.watchers.get(params["subscription"])
        if watcher is not None:
            watcher(params)

    def _refreshed(self, params: Any) -> None:
        self.stopped = params["stopped"]
        self.known = msgspec.convert(params["states"], Snapshot)
        # What a reload brought or took is known by the first states after it.
        if self.known.keys() != self.greeting.names.keys():
            self.task(self.rename())

    async def rename(self) -> None:
        with suppress(LinkDown):
            names = await self.ask("names", {}, dict[str, tuple[str, str]])
            self.greeting = msgspec.structs.replace(self.greeting, names=names)

    def _counted(self, params: Any) -> None:
        self.stats = params["stats"]

    def _told(self, params: Any) -> None:
        event = Event(params["name"], params["time"], params["fields"], params["missed"])
        if event.name == "estop":
            self.stopped = True
        elif event.name == "estop_cleared":
            self.stopped = False
        elif event.name == "lease_lost":
            self._lose(set(event.fields["servos"]) & self.held)
        self.announcer.tell(event)

    def _lose(self, servos: set[str]) -> None:
        self.held -= servos
        self.lost |= servos

    # Calls

    async def ask(self, method: str, params: Mapping[str, Any], kind: Any, patience: float = PATIENCE) -> Any:
        wire = self.wire
        if wire is None:
            raise LinkDown(f"the daemon is away ({self._why}): nothing was sent; it is called again by itself")
        answer = await wire.call(method, params, patience)
        try:
            return msgspec.convert(answer, kind)
        except msgspec.ValidationError as error:
            message = f"the daemon's answer to {method} cannot be read ({error}): are client and daemon of one version?"
            raise LinkDown(message) from None

    async def call(self, method: str, patience: float = PATIENCE, **params: Any) -> Any:
        return await self.ask(method, params, METHODS[method].result, patience)
