"""RemoteRig: the rig of a running daemon. A program cannot tell it from one whose ports it owns itself.

What needs no turn (`names`, `stopped`, `snapshot`, `stats`) is answered from what the daemon sends by itself: states `refresh_hz`
times a second, statistics once a second. Most verbs are calls of the daemon, made by `_forward` from the table in `rig/verbs.py`;
written out here are those for which a client does more. Motion needs the leases of its servos, which `leases.py` takes and keeps.
"""

from __future__ import annotations

import abc
import asyncio
import ssl
from collections.abc import AsyncIterator, Callable, Collection, Coroutine, Iterable, Mapping
from contextlib import asynccontextmanager, suppress
from dataclasses import asdict, replace
from functools import partial, wraps
from pathlib import Path
from typing import Any, Self, TypeVar, cast

import msgspec

from servobus.errors import InvalidRequest, LimitError, LinkDown, ServobusError
from servobus.remote.address import address_of, token_of
from servobus.remote.cache import LatestSnapshot, StateCache, received
from servobus.remote.connection import DaemonConnection
from servobus.remote.leases import ClientLeases
from servobus.remote.session import Opener, Session
from servobus.rig.events import Event, EventSource, EventStream
from servobus.rig.interface import Rig
from servobus.rig.verbs import DEADLINE, VERBS, Verb, arguments
from servobus.rpc.clock import machine
from servobus.rpc.methods import MAX_HZ, MIN_HZ, Greeting
from servobus.timers import clock_of
from servobus.values import (
    GOAL_NUMBERS,
    EventName,
    Goal,
    Outcome,
    Reload,
    ScanHit,
    Snapshot,
    State,
    StopReport,
    is_number,
    no_number,
)

T = TypeVar("T")
FOREVER = 1e9  # seconds in place of an infinity, which JSON does not have
MIN_LEASE = 0.1  # seconds: no daemon makes this client renew more often than this asks for
REFRESH_TIMEOUT = 1.0  # seconds that a verb which is done waits for the states that it changed


@asynccontextmanager
async def connect(
    address: str | Path | None = None,
    *,
    name: str = "",
    token: str | None = None,
    token_file: str | Path | None = None,
    tls: bool | str | Path | ssl.SSLContext = False,
    refresh_hz: float = 10.0,
) -> AsyncIterator[RemoteRig]:
    """Connect to a running daemon until the context ends.

    Left normally, motion goes on to its end. Left by an exception, the servos moved from here do their `on_lost_client`.

    Args:
        address: Path of the daemon's socket, or tcp://host:port; None: SERVOBUS_SOCKET or the usual place.
        name: What other clients read when this one holds a servo.
        token: The token of a TCP daemon.
        token_file: The file that holds it; it is read again for each connection. Neither: the file SERVOBUS_TOKEN_FILE.
        tls: True, the PEM file that signs the daemon's certificate, or an SSL context. False: SERVOBUS_CA_FILE, where it is set.
        refresh_hz: How often the daemon sends states for `snapshot`, 0.1 to 200 times a second.

    Returns: A context manager whose value is a RemoteRig.
    Raises: LinkDown, AccessDenied, NotSupported, ConfigError.
    """
    if not MIN_HZ <= refresh_hz <= MAX_HZ:
        raise ValueError(f"connect: refresh_hz {refresh_hz} is outside {MIN_HZ:g} to {MAX_HZ:g}")
    where = address_of(address, tls)
    rig = RemoteRig.make(str(where), where.open, partial(_hello, name, token, token_file), refresh_hz)
    try:
        await rig.start()
        yield rig
    except BaseException:
        await rig.leave(lost=True)
        raise
    await rig.leave(lost=False)


def _hello(name: str, token: str | None, token_file: str | Path | None) -> dict[str, Any]:
    """The parameters of a greeting now."""
    clock = clock_of(asyncio.get_running_loop())
    return {"client": name, "token": token_of(token, token_file), "machine": machine(), "asked": clock()}


def _forward(verb: Verb) -> Callable[..., Coroutine[Any, Any, Any]]:
    """The verb as a call of the daemon."""

    @wraps(verb.function)
    async def call(self: RemoteRig, *args: Any, **kwargs: Any) -> Any:
        params = arguments(verb, args, kwargs)
        if "names" in params:
            params["names"] = self.full_names(params["names"])
        elif next(iter(params), "") == "name":
            params["name"] = self.full_name(params["name"])
        return await self._call(verb.name, params)

    vars(call).pop("__isabstractmethod__", None)  # `wraps` copies it
    return call


def _with_all_verbs(rig: type[T]) -> type[T]:
    """Add the verbs that are still abstract."""
    abstract: frozenset[str] = getattr(rig, "__abstractmethods__", frozenset())
    for name in abstract & VERBS.keys():
        setattr(rig, name, _forward(VERBS[name]))
    return abc.update_abstractmethods(rig)


@_with_all_verbs
class RemoteRig(Rig):
    """Made by `servobus.connect`, and in use as long as that context.

    It connects again by itself. A call while there is no connection raises LinkDown at once; no call is ever repeated. After a
    verb that enables, disables or stops, `snapshot` and `stopped` are as that verb left them.
    """

    def __init__(self, address: str, opener: Opener, hello: Callable[[], dict[str, Any]], refresh_hz: float) -> None:
        self.greeting: Greeting | None = None
        """What the daemon said of itself last."""
        self._cache = StateCache()
        self._event_source = EventSource()
        self._session = Session(address, opener, hello, self._greeted, self._fill_cache, self._changed, self._progressed)
        self._leases = ClientLeases(self._session)
        self._refresh_hz = refresh_hz
        self._clock = clock_of(asyncio.get_running_loop())
        self._renaming: asyncio.Task[None] | None = None
        self._scans: dict[str, Callable[[int, int, ScanHit | None], None]] = {}
        self._watches: set[LatestSnapshot] = set()

    @classmethod
    def make(cls, address: str, opener: Opener, hello: Callable[[], dict[str, Any]], refresh_hz: float) -> Self:
        """A rig that is not connected yet."""
        return cls(address, opener, hello, refresh_hz)

    # Connection

    async def start(self) -> None:
        """Connect for the first time. Raises LinkDown, AccessDenied, NotSupported, ConfigError."""
        self._session.keep_subscribed({"topic": "state", "hz": self._refresh_hz}, self._states_came)
        self._session.keep_subscribed({"topic": "stats", "hz": 1.0}, lambda params: self._cache.put_stats(params["stats"]))
        self._session.keep_subscribed({"topic": "events"}, self._event_came)
        await self._session.connect()

    def _greeted(self, greeting: Greeting) -> None:
        self.greeting = greeting
        self._leases.begin(max(greeting.lease_ms / 1000, MIN_LEASE))
        self._cache.names, self._cache.stopped = greeting.names, greeting.stopped

    async def _fill_cache(self, connection: DaemonConnection) -> None:
        """Before a new connection is used: what `snapshot` and `stats` return."""
        await asyncio.gather(
            connection.call("snapshot", {}, timeout=DEADLINE, then=self._store),
            connection.call("stats", {}, timeout=DEADLINE, then=self._cache.put_stats),
        )

    @property
    def connected(self) -> bool:
        """The connection to the daemon is up."""
        return self._cache.down is None

    def _changed(self, lost: LinkDown | None) -> None:
        """The connection is up (None), or is lost for this reason."""
        before, self._cache.down = self._cache.down, lost
        if lost is not None:
            for latest in self._watches:
                latest.put(self._cache.snapshot(self._clock()))
            self._event_source.publish(Event(EventName.DAEMON_LOST, self._clock(), {"reason": lost.message}))
        elif before is not None:
            self._event_source.publish(Event(EventName.DAEMON_BACK, self._clock()))

    async def leave(self, *, lost: bool) -> None:
        """Close the connection. `lost`: leases are not given back, as if this process had been killed."""
        if self._renaming is not None:
            self._renaming.cancel()
        try:
            await self._leases.end(lost=lost)
        finally:
            await self._session.close(lost=lost)

    async def call(self, method: str, **params: Any) -> Any:
        """Call a `method` of the daemon that is no verb of a rig (`health`, `config`, `leases`) with these `params`."""
        return await self._session.call(method, params)

    async def _call(self, method: str, params: dict[str, Any], then: Callable[[Any], Any] | None = None) -> Any:
        """Call a verb. One that changes states reads them again afterwards, also when it failed for some servos."""
        try:
            result = await self._session.call(method, params, then=then)
        except ServobusError:
            await self._refresh_after(method)
            raise
        await self._refresh_after(method)
        return result

    # What is known without a turn

    @property
    def names(self) -> Mapping[str, tuple[str, str]]:
        return self._cache.names

    @property
    def stopped(self) -> bool:
        """Whether the e-stop was latched when the daemon last said so."""
        return self._cache.stopped

    def snapshot(self) -> Snapshot:
        """Not older than `refresh_hz` allows. While there is no connection: the last states, with their age, and offline."""
        return self._cache.snapshot(self._clock())

    def stats(self) -> dict[str, Any]:
        """As `Rig.stats`, about a second old at most. Raises LinkDown while there is no connection."""
        return self._cache.stats()

    def _store(self, states: Snapshot) -> Snapshot:
        """Store states the moment they come, so that they replace nothing newer."""
        now = self._clock()
        states = {name: received(state, now) for name, state in states.items()}
        self._cache.put(states)
        return states

    def _states_came(self, params: dict[str, Any]) -> Snapshot:
        states = self._store(msgspec.convert(params["states"], Snapshot))
        self._cache.stopped = bool(params["stopped"])
        if states.keys() != self._cache.names.keys() and (self._renaming is None or self._renaming.done()):
            self._renaming = asyncio.create_task(self._rename())  # the daemon read its config again
        return states

    def _event_came(self, params: dict[str, Any]) -> None:
        event = Event(str(params["name"]), self._clock(), dict(params.get("fields", {})), int(params.get("missed", 0)))
        self._event_source.publish(event)

    def _progressed(self, params: dict[str, Any]) -> None:
        progress, hit = self._scans.get(params["bus"]), params.get("found")
        if progress is not None:
            progress(params["asked"], params["count"], None if hit is None else msgspec.convert(hit, ScanHit))

    async def _rename(self) -> None:
        with suppress(ServobusError):  # the next notice asks again
            self._cache.names = await self._session.call("names", {})

    async def _refresh_after(self, method: str) -> None:
        if VERBS[method].refreshes:
            with suppress(ServobusError):  # the verb itself is done
                await self._session.call("snapshot", {}, timeout=REFRESH_TIMEOUT, then=self._store)

    async def watch(self, hz: float = 10.0) -> AsyncIterator[Snapshot]:
        """As `Rig.watch`, with `hz` up to 200. When the connection is lost, a snapshot shows every servo offline."""
        if not MIN_HZ <= hz <= 1000:
            async for snapshot in super().watch(hz):
                yield snapshot
        latest = LatestSnapshot()
        subscription = await self._session.subscribe(
            {"topic": "state", "hz": min(hz, MAX_HZ)}, lambda params: latest.put(self._states_came(params))
        )
        self._watches.add(latest)
        try:
            yield self.snapshot()
            while True:
                yield self._cache.aged(await latest.get(), self._clock())
        finally:
            self._watches.discard(latest)
            self._session.unsubscribe(subscription)

    def events(self) -> EventStream:
        """As `Rig.events`, with `daemon_lost` and `daemon_back`: between these two, events may have been lost. An event
        has the time of its arrival here."""
        return self._event_source.stream()

    # Verbs with something of their own

    async def send_all(self, goals: Mapping[str, Goal], *, together: bool = False, confirm: bool = False) -> dict[str, Outcome]:
        checked: dict[str, Goal] = {}
        asked = self._clock()
        for name, goal in goals.items():
            if (full := self.full_name(name)) in checked:
                raise InvalidRequest(f"{full} is named twice: give it one goal; nothing was sent")
            checked[full] = self._checked(full, goal)
        if not checked:
            return {}
        plain = {name: asdict(goal) for name, goal in checked.items()}
        params = {"goals": plain, "together": together, "confirm": confirm, "asked": asked}
        return cast("dict[str, Outcome]", await self._leases.move("send_all", checked, params, partial(_exactly, checked)))

    def _checked(self, name: str, goal: Goal) -> Goal:
        """The goal with plain numbers. What is not a finite number is refused here, because JSON cannot carry it."""
        numbers: dict[str, Any] = {}
        for field in GOAL_NUMBERS:
            value = getattr(goal, field)
            if value is None and field != "value":
                continue
            self._require_number(name, field, value)
            numbers[field] = float(value)
        return replace(goal, **numbers)

    def _require_number(self, name: str, what: str, value: Any) -> None:
        if not is_number(value):
            bus, servo = self.names[name]
            raise LimitError(no_number(what, value), bus=bus, servo=servo)

    async def acquire(self, *names: str) -> None:
        await self._leases.acquire(self.full_names(names))

    async def release(self, *names: str) -> None:
        await self._leases.release(self.full_names(names))

    async def stop(self) -> dict[str, StopReport]:
        return cast("dict[str, StopReport]", await self._call("stop", {}, partial(self._latch, True)))

    async def clear(self) -> tuple[str, ...]:
        return cast("tuple[str, ...]", await self._call("clear", {}, partial(self._latch, False)))

    def _latch(self, stopped: bool, result: T) -> T:
        self._cache.stopped = stopped
        return result

    async def settle(self, *names: str, tolerance: float | None = None, timeout: float = 10.0) -> Snapshot:
        full = self.full_names(names)
        params = {"names": full, "tolerance": _bounded(tolerance), "timeout": min(timeout, FOREVER)}
        states: Snapshot = await self._session.call(
            "settle", params, timeout=min(timeout, FOREVER) + DEADLINE, then=lambda states: self._store(_exactly(full, states))
        )
        return states

    async def read(self, name: str, *, max_age: float | None = None) -> State:
        full = self.full_name(name)
        params = {"name": full, "max_age": _bounded(max_age)}
        return cast("State", await self._session.call("read", params, then=lambda state: self._store({full: state})[full]))

    async def write_register(self, name: str, register: str, value: Any, *, raw: bool = False, persist: bool = False) -> Any:
        full = self.full_name(name)
        self._require_number(full, f"register {register}", value)
        params = {"name": full, "register": register, "value": value, "raw": raw, "persist": persist}
        return await self._call("write_register", params)

    async def scan(
        self,
        bus: str,
        *,
        baudrates: Iterable[int] = (),
        ids: Iterable[int] = (),
        progress: Callable[[int, int, ScanHit | None], None] | None = None,
    ) -> list[ScanHit]:
        """As `Rig.scan` (`bus`, `baudrates`, `ids`, `progress`)."""
        params = {"bus": bus, "baudrates": list(baudrates), "ids": list(ids), "progress": True}
        call = asyncio.ensure_future(self._session.call("scan", params))
        failures: list[Exception] = []

        def report(asked: int, count: int, hit: ScanHit | None) -> None:
            try:
                if progress is not None and not failures:
                    progress(asked, count, hit)
            except Exception as error:  # noqa: BLE001 - the caller's own, and raised there
                failures.append(error)
                call.cancel()

        self._scans[bus] = report
        try:
            hits: list[ScanHit] = await call
        except asyncio.CancelledError:
            if failures:
                raise failures[0] from None
            raise
        finally:
            self._scans.pop(bus, None)
        return hits

    async def reload(self, *, force: bool = False) -> Reload:
        report: Reload = await self._session.call("reload", {"force": force})
        await self._rename()
        await self._refresh_after("reload")
        return report


def _exactly(names: Collection[str], results: dict[str, T]) -> dict[str, T]:
    """Refuse a reply that is about other servos."""
    if results.keys() != set(names):
        raise ValueError(f"a reply about {', '.join(results) or 'nothing'}, not about {', '.join(names)}")
    return results


def _bounded(seconds: float | None) -> float | None:
    return None if seconds is None else min(seconds, FOREVER)
