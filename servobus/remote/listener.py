"""What a client hears of a rig without asking: who is there, states, statistics, events. The half of `RemoteRig` that listens.

What needs no turn (`names`, `stopped`, `snapshot`, `stats`) is answered from what the daemon sends by itself: states `refresh_hz`
times a second, statistics once a second.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import suppress
from typing import Any

import msgspec

from servobus.errors import LinkDown, ServobusError
from servobus.remote.cache import LatestSnapshot, StateCache, received
from servobus.remote.connection import Connection
from servobus.remote.leases import ClientLeases
from servobus.remote.session import DEADLINE, Dial, Session
from servobus.rig.events import Event, EventSource, EventStream
from servobus.rig.interface import Rig
from servobus.rpc.methods import MAX_HZ, MIN_HZ, Greeting
from servobus.values import EventName, ScanHit, Snapshot

SHORTEST_LEASE = 0.1
"""Seconds; no daemon makes us renew more often than that asks for."""
REFRESH_TIMEOUT = 1.0
"""Seconds a verb that is done waits for what it has changed."""


class Listening(Rig):
    """A rig that the other end tells about."""

    def __init__(self, place: str, dial: Dial, hello: Callable[[], dict[str, Any]], refresh_hz: float) -> None:
        self._cache = StateCache()
        self._event_source = EventSource()
        self._session = Session(place, dial, hello, self._greeted, self._know, self._changed, self._progressed)
        self._leases = ClientLeases(self._session)
        self._refresh_hz = refresh_hz
        self._clock = asyncio.get_running_loop().time
        self._renaming: asyncio.Task[None] | None = None
        self._scanning: dict[str, Callable[[int, int, ScanHit | None], None]] = {}
        self._watching: set[LatestSnapshot] = set()
        self.greeting: Greeting | None = None
        """What the daemon said of itself last."""

    # Connection

    async def start(self) -> None:
        self._session.want({"topic": "state", "hz": self._refresh_hz}, self._seen)
        self._session.want({"topic": "stats", "hz": 1.0}, lambda told: self._cache.counted(told["stats"]))
        self._session.want({"topic": "events"}, self._happened)
        await self._session.connect()

    def _greeted(self, greeting: Greeting) -> None:
        self.greeting = greeting
        self._leases.begin(max(greeting.lease_ms / 1000, SHORTEST_LEASE))
        self._cache.names, self._cache.stopped = greeting.names, greeting.stopped

    async def _know(self, wire: Connection) -> None:
        """A connection is there: what `snapshot` and `stats` have to say."""
        await asyncio.gather(
            wire.call("snapshot", {}, timeout=DEADLINE, then=self._learnt),
            wire.call("stats", {}, timeout=DEADLINE, then=self._cache.counted),
        )

    def _changed(self, lost: LinkDown | None) -> None:
        """The connection is there, or no more."""
        was, self._cache.down = self._cache.down, lost
        if lost is not None:
            for newest in self._watching:
                newest.put(self._cache.snapshot(self._clock()))
            self._event_source.publish(Event(EventName.DAEMON_LOST, self._clock(), {"reason": lost.message}))
        elif was is not None:
            self._event_source.publish(Event(EventName.DAEMON_BACK, self._clock()))

    async def leave(self, *, lost: bool) -> None:
        """Give back what is held, unless `lost`; then hang up."""
        if self._renaming is not None:
            self._renaming.cancel()
        try:
            await self._leases.end(lost=lost)
        finally:
            await self._session.close(lost=lost)

    async def call(self, method: str, **params: Any) -> Any:
        """A method of the door that is no verb of a rig: `health`, `config`, `leases`."""
        return await self._session.call(method, params)

    # What is known without a turn

    @property
    def names(self) -> Mapping[str, tuple[str, str]]:
        return self._cache.names

    @property
    def stopped(self) -> bool:
        """As last heard; while there is no connection, nobody knows."""
        return self._cache.stopped

    def snapshot(self) -> Snapshot:
        """Not older than `refresh_hz` allows. While there is no connection: the last, with its age, and offline."""
        return self._cache.snapshot(self._clock())

    def stats(self) -> dict[str, Any]:
        """About a second old at most. Raises LinkDown while there is no connection."""
        return self._cache.stats()

    def _learnt(self, states: Snapshot) -> Snapshot:
        """At the moment they come, so that nothing newer is replaced."""
        now = self._clock()
        states = {name: received(state, now) for name, state in states.items()}
        self._cache.know(states)
        return states

    def _seen(self, told: dict[str, Any]) -> Snapshot:
        """A state notice."""
        states = self._learnt(msgspec.convert(told["states"], Snapshot))
        self._cache.stopped = bool(told["stopped"])
        if states.keys() != self._cache.names.keys() and (self._renaming is None or self._renaming.done()):
            self._renaming = asyncio.create_task(self._rename())  # the config was read anew
        return states

    async def _rename(self) -> None:
        with suppress(ServobusError):  # the next notice asks again
            self._cache.names = await self._session.call("names", {})

    async def _refresh(self) -> None:
        """After a verb that has changed what all may see."""
        with suppress(ServobusError):  # the verb itself was done
            await self._session.call("snapshot", {}, timeout=REFRESH_TIMEOUT, then=self._learnt)

    async def watch(self, hz: float = 10.0) -> AsyncIterator[Snapshot]:
        """Snapshots as the daemon sends them, at most 200 a second; a slow reader gets fewer, never old ones. When the
        connection is lost there is one with every servo offline, and when it is back they go on."""
        if not MIN_HZ <= hz <= 1000:
            async for snapshot in super().watch(hz):
                yield snapshot
        newest = LatestSnapshot()
        subscription = await self._session.subscribe(
            {"topic": "state", "hz": min(hz, MAX_HZ)}, lambda told: newest.put(self._seen(told))
        )
        self._watching.add(newest)
        try:
            yield self.snapshot()
            while True:
                yield self._cache.aged(await newest.get(), self._clock())
        finally:
            self._watching.discard(newest)
            self._session.unsubscribe(subscription)

    def events(self) -> EventStream:
        """As `Rig.events`, with `daemon_lost` and `daemon_back`: between these two, events may have been lost. An event
        has the time of its arrival here."""
        return self._event_source.stream()

    def _happened(self, told: dict[str, Any]) -> None:
        self._event_source.publish(
            Event(str(told["name"]), self._clock(), dict(told.get("fields", {})), int(told.get("missed", 0)))
        )

    def _progressed(self, told: dict[str, Any]) -> None:
        progress = self._scanning.get(told["bus"])
        if progress is not None:
            found = told.get("found")
            progress(told["asked"], told["count"], None if found is None else msgspec.convert(found, ScanHit))
