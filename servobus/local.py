"""LocalRig: the rig whose ports this process owns.

Each bus has a keeper: it opens the port, introduces the servos, waits for the line to go down and opens it again, and
none of it touches another bus. Nothing is written at start; at the end every servo that was enabled here is left as its
`on_exit` says.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Coroutine, Iterable, Mapping
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import anyio
import structlog

from servobus.bus.scan import scan
from servobus.bus.service import BusService
from servobus.config import Config, load_config
from servobus.errors import EStopped, LimitError, LinkDown, UnknownName
from servobus.links import open_link
from servobus.links.base import Link
from servobus.protocols.options import BusOptions
from servobus.protocols.table import PROTOCOLS
from servobus.protocols.words import Change, Goal, Identity, Outcome, State, StopReport
from servobus.rig import Found, Rig, Snapshot, outcomes, raise_failures, uncancelled
from servobus.sim.build import SimLink, simulated_link

R = TypeVar("R")
Trace = Callable[[str, bool, bytes, float], None]
"""(bus, sent, bytes, monotonic seconds) of everything on the wire."""

RETRY = 0.1
"""Seconds between two looks for a port that is not there."""
EXIT_TIMEOUT = 1.0
"""Seconds the exit policies may take, parking apart."""

log = structlog.get_logger("servobus")


class LocalRig(Rig):
    """Made by `servobus.open`, and alive as long as that context."""

    def __init__(self, config: Config, only: Collection[str] = (), trace: Trace | None = None) -> None:
        self.config = config
        self.buses: dict[str, BusService] = {}
        self.links: dict[str, Link] = {}
        self.left: dict[str, StopReport] = {}
        """What became of each servo that was still enabled at the end, by full name; filled when the context has ended."""
        self._names = {name: place for name, place in config.names.items() if not only or place[0] in only}
        self._tried: dict[str, asyncio.Event] = {}
        self._down: dict[str, LinkDown] = {}
        self._stopping: set[asyncio.Task[Any]] = set()
        for name in only or config.buses:
            self._add(name, config.buses[name])
            if trace is not None:
                self.buses[name].master.trace = partial(trace, name)

    def _add(self, name: str, options: BusOptions) -> None:
        entry, models = PROTOCOLS[options.protocol], self.config.models[name]
        link = (
            simulated_link(options, models)
            if options.port.startswith("sim:")
            else open_link(options.port, options.baudrate, rs485=options.rs485)
        )
        driver = entry.driver(options, models)
        self.links[name] = link
        self.buses[name] = BusService(name, options, driver, entry.codec(options), link.traits, self._event)
        self._tried[name] = asyncio.Event()

    @property
    def names(self) -> Mapping[str, tuple[str, str]]:
        return self._names

    def bus_of(self, name: str) -> tuple[BusService, str]:
        """The bus and the bare name of a servo, by full or unique bare name. Raises UnknownName."""
        bus, servo = self._names.get(name) or self._names[self.full_name(name)]
        return self.buses[bus], servo

    # Lines

    async def keep(self, name: str, degraded: bool) -> None:
        """Open the line, and again whenever it is gone. Ends by being cancelled."""
        bus, link = self.buses[name], self.links[name]
        while True:
            bus.line.traits = link.traits  # what the port is may have changed while it was away
            try:
                await link.connect(bus.master)
            except LinkDown as error:
                tried = self._tried[name].is_set()  # the first time it may be raised, and need not be told twice
                if (tried or degraded) and str(error) != str(self._down.get(name)):
                    self._event("waiting_for_port", bus=name, port=link.address, reason=error.message)
                self._down[name] = error
                self._tried[name].set()
                await anyio.sleep(RETRY)
                continue
            self._down.pop(name, None)
            self._event("line_up", bus=name, port=link.address)
            await bus.start()
            self._tried[name].set()
            await bus.master.wait_closed()
            self._event("line_down", bus=name, port=link.address)

    async def ready(self, *, degraded: bool) -> None:
        """Until every line was tried. Raises the first LinkDown, unless `degraded`."""
        for tried in self._tried.values():
            await tried.wait()
        if self._down and not degraded:
            name, error = next(iter(self._down.items()))
            raise error.at(bus=name)

    async def leave(self) -> None:
        """Exit policies, on all buses at once: park first where a servo says so. `left` tells what became of each servo."""
        await asyncio.gather(*self._stopping)
        for bus in self.buses.values():
            bus.motion.leaving = True
            for record in bus.motion.to_leave():
                self.left[f"{bus.name}/{record.name}"] = StopReport(record.options.on_exit, False, False, "no answer in time")
        parking = [] if self.stopped else self._enabled("on_exit", "park")  # what the e-stop holds stays
        reports = await asyncio.gather(*(self._park(bus, servo) for bus, servo in parking))
        self.left.update({f"{bus.name}/{servo}": report for (bus, servo), report in zip(parking, reports, strict=True)})
        await asyncio.gather(*(self._leave(bus) for bus in self.buses.values()))
        for name, report in self.left.items():
            if not report.confirmed and report.action != "park":  # that has its own event
                self._event("exit_unconfirmed", servo=name, action=report.action, detail=report.detail)

    async def _leave(self, bus: BusService) -> None:
        with anyio.move_on_after(EXIT_TIMEOUT):
            for servo, report in (await bus.motion.leave()).items():
                self.left[f"{bus.name}/{servo}"] = report

    async def close(self) -> None:
        """Every line, once nobody opens them again."""
        await asyncio.gather(*(bus.master.close() for bus in self.buses.values()))
        for link in self.links.values():
            if isinstance(link, SimLink):
                link.close()

    # Motion

    async def send_all(self, goals: Mapping[str, Goal], *, together: bool = False, confirm: bool = False) -> dict[str, Outcome]:
        parts: dict[BusService, dict[str, Goal]] = {}
        for name, goal in goals.items():
            bus, servo = self.bus_of(name)
            if servo in parts.setdefault(bus, {}):
                raise LimitError(f"{self.full_name(name)} is named twice: give it one goal; nothing was sent")
            parts[bus][servo] = goal
        checked = {bus: bus.motion.check(part) for bus, part in parts.items()}
        futures = {
            f"{bus.name}/{servo}": future
            for bus, part in checked.items()
            for servo, future in bus.motion.put(part, together=together, confirm=confirm).items()
        }
        return await outcomes(futures)

    async def enable(self, *names: str) -> None:
        await self._each(names, lambda bus, servo: bus.motion.enable(servo))

    async def disable(self, *names: str) -> None:
        await self._each(names, lambda bus, servo: bus.motion.disable(servo))

    async def stop(self) -> dict[str, StopReport]:
        stopping = self._track(self._stop_all())
        return await asyncio.shield(stopping)  # a caller that leaves does not end it

    async def _stop_all(self) -> dict[str, StopReport]:
        self._event("estop")
        parking = self._enabled("on_estop", "park")
        reports = await asyncio.gather(*(bus.motion.stop() for bus in self.buses.values()))
        for bus, servo in parking:
            self._track(self._park(bus, servo))
        return {
            f"{bus}/{servo}": entry for bus, report in zip(self.buses, reports, strict=True) for servo, entry in report.items()
        }

    def _track(self, work: Coroutine[Any, Any, R]) -> asyncio.Task[R]:
        task = asyncio.create_task(work)
        self._stopping.add(task)
        task.add_done_callback(self._stopping.discard)
        return task

    async def clear(self) -> None:
        if self._stopping:
            raise EStopped("servos are still being stopped or parked: clear when they stand")
        for bus in self.buses.values():
            bus.motion.latched = False
        self._event("estop_cleared")

    @property
    def stopped(self) -> bool:
        return any(bus.motion.latched for bus in self.buses.values())

    async def settle(self, *names: str, tolerance: float | None = None, timeout: float = 10.0) -> Snapshot:
        full = self.full_names(names)
        places = [self.bus_of(name) for name in full]
        waits = (bus.motion.settle(servo, tolerance=tolerance, timeout=timeout) for bus, servo in places)
        return dict(zip(full, await asyncio.gather(*waits), strict=True))

    async def _park(self, bus: BusService, servo: str) -> StopReport:
        """To the park pose, then limp; limp also when it does not get there in time."""
        report = await bus.motion.park(servo)
        if not report.confirmed:
            self._event("park_unconfirmed", bus=bus.name, servo=servo, detail=report.detail)
        return report

    def _enabled(self, policy: str, kind: str) -> list[tuple[BusService, str]]:
        return [
            (bus, record.name)
            for bus in self.buses.values()
            for record in bus.records.values()
            if record.enabled and getattr(record.options, policy) == kind
        ]

    # Reading

    async def read(self, name: str, *, max_age: float | None = None) -> State:
        bus, servo = self.bus_of(name)
        return await bus.read(servo, max_age)

    def snapshot(self) -> Snapshot:
        return {name: self.buses[bus].state(servo) for name, (bus, servo) in self._names.items()}

    async def read_register(self, name: str, register: str, *, raw: bool = False) -> Any:
        bus, servo = self.bus_of(name)
        return await bus.read_register(servo, register, raw=raw)

    async def write_register(self, name: str, register: str, value: Any, *, raw: bool = False, persist: bool = False) -> Any:
        bus, servo = self.bus_of(name)
        return await bus.write_register(servo, register, value, raw=raw, persist=persist)

    async def ping(self, name: str) -> int | None:
        bus, servo = self.bus_of(name)
        return await bus.ping(servo)

    async def identify(self, name: str) -> Identity:
        bus, servo = self.bus_of(name)
        return await bus.identify(servo)

    async def scan(
        self,
        bus: str,
        *,
        baudrates: Iterable[int] = (),
        ids: Iterable[int] = (),
        progress: Callable[[int, int, Found | None], None] | None = None,
    ) -> list[Found]:
        service = self._bus(bus)
        every = PROTOCOLS[service.options.protocol].scan_ids
        found = []
        async for asked, count, entry in scan(service, list(baudrates) or [service.options.baudrate], list(ids) or list(every)):
            hit = None if entry is None else Found(bus, *entry)
            if hit:
                found.append(hit)
            if progress:
                progress(asked, count, hit)
        return found

    async def set_id(self, bus: str, node: int, new: int, *, save: bool = False) -> Change:
        return await self._bus(bus).commission(node, lambda plans: plans.set_id(node, new, save=save))

    async def set_baudrate(self, bus: str, node: int, baudrate: int, *, save: bool = False) -> Change:
        return await self._bus(bus).commission(node, lambda plans: plans.set_baudrate(node, baudrate, save=save))

    def _bus(self, name: str) -> BusService:
        if name not in self.buses:
            raise UnknownName(f"no bus {name!r}: there are {', '.join(self.buses)}")
        return self.buses[name]

    def stats(self) -> dict[str, Any]:
        return {name: bus.snapshot() for name, bus in self.buses.items()}

    async def _each(self, names: Iterable[str], verb: Callable[[BusService, str], Awaitable[None]]) -> None:
        """Every servo is tried, whatever happens to another."""
        full = self.full_names(names)
        results = await asyncio.gather(*(verb(*self.bus_of(name)) for name in full), return_exceptions=True)
        raise_failures(dict(zip(full, results, strict=True)))

    @staticmethod
    def _event(name: str, **fields: Any) -> None:
        quiet = name in {"line_up", "echo_probed", "estop_cleared", "servo_online"}
        (log.info if quiet else log.warning)(name, **fields)


@asynccontextmanager
async def open_rig(
    config: str | Path | Config, *, buses: Collection[str] = (), degraded: bool = False, trace: Trace | None = None
) -> AsyncIterator[LocalRig]:
    """This process owns the ports of `config` (a path, or a loaded Config) until the context ends; then each servo enabled here
    is left as its `on_exit` says. `buses`: only these. `degraded`: ports that cannot be opened are waited for instead of raising.
    `trace` is called with every piece of bytes on the wire, both ways.
    Raises ConfigError, PortMissing, PortBusy, PortDenied, LinkDown."""
    rig = LocalRig(config if isinstance(config, Config) else load_config(config), buses, trace)
    failure: BaseException | None = None
    async with anyio.create_task_group() as keepers:
        try:
            for name in rig.buses:
                keepers.start_soon(rig.keep, name, degraded)
            await rig.ready(degraded=degraded)
            yield rig
        except BaseException as error:  # noqa: BLE001 - raised again below, outside the group, which would wrap it
            failure = error
        cancelled = await uncancelled(rig.leave())
        keepers.cancel_scope.cancel()
    cancelled = await uncancelled(rig.close()) or cancelled
    if failure or cancelled:
        raise failure or cancelled  # type: ignore[misc]
