"""RemoteRig: the rig of a running daemon. A program cannot tell it from one whose ports it owns itself.

Motion needs its servos' leases, which it takes and keeps by itself (`holding.py`). After a verb that enables, disables or stops,
`snapshot` and `stopped` are as that verb has left them.
"""

from __future__ import annotations

import asyncio
import ssl
from collections.abc import AsyncIterator, Callable, Collection, Iterable, Mapping
from contextlib import asynccontextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, TypeVar

from servobus.errors import InvalidRequest, LimitError, ServobusError
from servobus.remote.address import address_of, token_of
from servobus.remote.listener import Listening
from servobus.remote.session import DEADLINE
from servobus.rpc.methods import MAX_HZ, MIN_HZ
from servobus.values import (
    GOAL_NUMBERS,
    Change,
    Goal,
    Identity,
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
FOREVER = 1e9


@asynccontextmanager
async def connect(
    place: str | Path | None = None,
    *,
    name: str = "",
    token: str | None = None,
    token_file: str | Path | None = None,
    tls: bool | str | Path | ssl.SSLContext = False,
    refresh_hz: float = 10.0,
) -> AsyncIterator[RemoteRig]:
    """The rig of the daemon at `place`: the path of its socket (none: the usual one), or tcp://host:port with its token. `name`:
    what others read when this client holds a servo. `tls`: True, the PEM file that signs the daemon's certificate, or a context.
    Left normally, motion goes on to its end; left by an exception, the servos moved from here do their `on_lost_client`.
    Raises LinkDown, AccessDenied, NotSupported, ConfigError."""
    if not MIN_HZ <= refresh_hz <= MAX_HZ:
        raise ValueError(f"connect: refresh_hz {refresh_hz} is outside {MIN_HZ:g} to {MAX_HZ:g}")
    address = address_of(place, tls)
    rig = RemoteRig(str(address), address.dial, lambda: {"client": name, "token": token_of(token, token_file)}, refresh_hz)
    try:
        await rig.start()
        yield rig
    except BaseException:
        await rig.leave(lost=True)
        raise
    await rig.leave(lost=False)


class RemoteRig(Listening):
    """Made by `servobus.connect`, and alive as long as that context. It connects anew by itself; a call while there is no
    connection raises LinkDown at once, and none is ever repeated."""

    # Motion

    async def send_all(self, goals: Mapping[str, Goal], *, together: bool = False, confirm: bool = False) -> dict[str, Outcome]:
        full: dict[str, Goal] = {}
        for name, goal in goals.items():
            if (whole := self.full_name(name)) in full:
                raise InvalidRequest(f"{whole} is named twice: give it one goal; nothing was sent")
            full[whole] = self._checked(whole, goal)
        if not full:
            return {}
        params = {"goals": {name: asdict(goal) for name, goal in full.items()}, "together": together, "confirm": confirm}
        outcomes: dict[str, Outcome] = await self._leases.move("send_all", full, params, lambda told: _about(full, told))
        return outcomes

    def _checked(self, name: str, goal: Goal) -> Goal:
        """JSON has no word for what is no number, so that is refused here."""
        numbers: dict[str, Any] = {}
        for field in GOAL_NUMBERS:
            value = getattr(goal, field)
            if value is None and field != "value":
                continue
            if not is_number(value):
                bus, servo = self.names[name]
                raise LimitError(no_number(field, value), bus=bus, servo=servo)
            numbers[field] = float(value)
        return replace(goal, **numbers)

    async def acquire(self, *names: str) -> None:
        await self._leases.acquire(self.full_names(names))

    async def release(self, *names: str) -> None:
        await self._leases.release(self.full_names(names))

    async def enable(self, *names: str) -> None:
        await self._do("enable", {"names": self.full_names(names)})

    async def disable(self, *names: str) -> None:
        await self._do("disable", {"names": self.full_names(names)})

    async def stop(self) -> dict[str, StopReport]:
        def latched(reports: dict[str, StopReport]) -> dict[str, StopReport]:
            self._cache.stopped = True
            return reports

        reports: dict[str, StopReport] = await self._do("stop", {}, then=latched)
        return reports

    async def clear(self) -> None:
        def released(_: None) -> None:
            self._cache.stopped = False

        await self._do("clear", {}, then=released)

    async def _do(self, method: str, params: dict[str, Any], then: Callable[[Any], Any] | None = None) -> Any:
        """A verb after which `snapshot` is to be as it has left the servos, even when it failed for some."""
        try:
            result = await self._session.call(method, params, then=then)
        except ServobusError:
            await self._refresh()
            raise
        await self._refresh()
        return result

    async def settle(self, *names: str, tolerance: float | None = None, timeout: float = 10.0) -> Snapshot:
        full, near = self.full_names(names), None if tolerance is None else _bounded(tolerance)
        params = {"names": full, "tolerance": near, "timeout": _bounded(timeout)}

        def learnt(states: Snapshot) -> Snapshot:
            return self._learnt(_about(full, states))

        settled: Snapshot = await self._session.call("settle", params, timeout=_bounded(timeout) + DEADLINE, then=learnt)
        return settled

    # One servo

    async def read(self, name: str, *, max_age: float | None = None) -> State:
        full = self.full_name(name)
        params = {"name": full, "max_age": None if max_age is None else _bounded(max_age)}
        state: State = await self._session.call("read", params, then=lambda state: self._learnt({full: state})[full])
        return state

    async def read_register(self, name: str, register: str, *, raw: bool = False) -> Any:
        return await self._session.call("read_register", {"name": self.full_name(name), "register": register, "raw": raw})

    async def write_register(self, name: str, register: str, value: Any, *, raw: bool = False, persist: bool = False) -> Any:
        full = self.full_name(name)
        if not is_number(value):
            bus, servo = self.names[full]
            raise LimitError(no_number(f"register {register}", value), bus=bus, servo=servo)
        params = {"name": full, "register": register, "value": value, "raw": raw, "persist": persist}
        return await self._session.call("write_register", params)

    async def ping(self, name: str) -> int | None:
        health: int | None = await self._session.call("ping", {"name": self.full_name(name)})
        return health

    async def identify(self, name: str) -> Identity:
        identity: Identity = await self._session.call("identify", {"name": self.full_name(name)})
        return identity

    # A bus, and all

    async def scan(
        self,
        bus: str,
        *,
        baudrates: Iterable[int] = (),
        ids: Iterable[int] = (),
        progress: Callable[[int, int, ScanHit | None], None] | None = None,
    ) -> list[ScanHit]:
        """As `Rig.scan`; one that its caller leaves goes on to its end at the daemon."""
        params = {"bus": bus, "baudrates": list(baudrates), "ids": list(ids), "progress": True}
        call = asyncio.ensure_future(self._session.call("scan", params))
        failed: list[Exception] = []

        def report(asked: int, count: int, found: ScanHit | None) -> None:
            try:
                if progress is not None and not failed:
                    progress(asked, count, found)
            except Exception as error:  # noqa: BLE001 - the caller's own, and raised there
                failed.append(error)
                call.cancel()

        self._scanning[bus] = report
        try:
            found: list[ScanHit] = await call
        except asyncio.CancelledError:
            if failed:
                raise failed[0] from None
            raise
        finally:
            self._scanning.pop(bus, None)
        return found

    async def set_id(self, bus: str, node: int, new: int, *, save: bool = False) -> Change:
        change: Change = await self._session.call("set_id", {"bus": bus, "node": node, "new": new, "save": save})
        return change

    async def set_baudrate(self, bus: str, node: int, baudrate: int, *, save: bool = False) -> Change:
        params = {"bus": bus, "node": node, "baudrate": baudrate, "save": save}
        change: Change = await self._session.call("set_baudrate", params)
        return change

    async def command(self, bus: str, node: int, name: str, value: int | None = None) -> tuple[str, ...]:
        told: tuple[str, ...] = await self._session.call("command", {"bus": bus, "node": node, "name": name, "value": value})
        return told

    async def reload(self) -> Reload:
        report: Reload = await self._session.call("reload", {})
        await self._rename()
        await self._refresh()
        return report


def _about(names: Collection[str], told: dict[str, T]) -> dict[str, T]:
    """An answer about other servos is none."""
    if told.keys() != set(names):
        raise ValueError(f"an answer about {', '.join(told) or 'nothing'}, not about {', '.join(names)}")
    return told


def _bounded(seconds: float) -> float:
    """JSON has no infinity."""
    return seconds if seconds < FOREVER else FOREVER
