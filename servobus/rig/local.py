"""LocalRig: the rig whose ports this process owns. `supervisor.py` opens and leaves each bus, `bus/` does the work on it."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Coroutine, Iterable, Mapping
from contextlib import asynccontextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, TypeVar

import anyio
from anyio.abc import TaskGroup

from servobus.bus.scan import scan
from servobus.bus.service import BusService
from servobus.config.loader import Config, load_config
from servobus.errors import Busy, GoalExpired, InvalidRequest, NotSupported, UnknownName
from servobus.protocols.registry import PROTOCOLS
from servobus.rig.events import Event, EventSource, EventStream
from servobus.rig.interface import Rig
from servobus.rig.latch import LatchFile
from servobus.rig.logs import EventLogger
from servobus.rig.results import outcomes, raise_failures, uncancelled
from servobus.rig.supervisor import BusSupervisor, Trace, why_not_to_close
from servobus.values import Change, EventName, Goal, Identity, Outcome, Reload, ScanHit, Snapshot, State, StopReport

R = TypeVar("R")
QUIET = {EventName.LINE_UP, EventName.ECHO_PROBED, EventName.ESTOP_CLEARED, EventName.SERVO_ONLINE, EventName.RELOADED}
"""Events that are logged as information, the others as warnings."""

log = EventLogger("servobus.rig")


class LocalRig(Rig):
    """Made by `servobus.open`, and in use as long as that context."""

    def __init__(
        self,
        config: Config,
        supervisors: TaskGroup,
        only: Collection[str] = (),
        trace: Trace | None = None,
        path: Path | None = None,
        latch: LatchFile | None = None,
    ) -> None:
        self.config = config
        self.path = path
        """The file that `reload` reads; None: there is none."""
        self.left: dict[str, StopReport] = {}
        """How each servo was left that was enabled at the end, by full name; filled when the context has ended."""
        self.event_source = EventSource()
        self._only = only
        self._trace = trace
        self._group = supervisors
        self._stopping: set[asyncio.Task[Any]] = set()
        self._reloading: asyncio.Task[Reload] | None = None
        self.supervisors = {name: self._supervisor(name, config) for name in only or config.buses}
        self._index()
        self._latch = latch
        if latch is not None and latch.latched():  # each bus stops its servos when its line is open
            log.warning("estop_latched", reason="it was latched before this process began: `servobus clear` releases it")
            self._set_latch(latched=True)

    def _supervisor(self, name: str, config: Config) -> BusSupervisor:
        return BusSupervisor(name, config.buses[name], config.models[name], self._event, self._trace)

    def _index(self) -> None:
        """The buses and names that belong to the supervisors."""
        self.buses: dict[str, BusService] = {name: supervisor.bus for name, supervisor in self.supervisors.items()}
        self._names = {name: pair for name, pair in self.config.names.items() if pair[0] in self.supervisors}
        bare = Counter(servo for _, servo in self._names.values())
        unique = {servo: (bus, servo) for bus, servo in self._names.values() if bare[servo] == 1}
        self._targets = {**unique, **self._names}

    @property
    def names(self) -> Mapping[str, tuple[str, str]]:
        return self._names

    def bus_of(self, name: str) -> tuple[BusService, str]:
        """The bus and the bare name of the servo `name`. Raises UnknownName."""
        bus, servo = self._targets.get(name) or self._names[self.full_name(name)]
        return self.buses[bus], servo

    # Lines

    async def start(self, *, degraded: bool) -> None:
        """Open every line, or try to. Raises the first LinkDown, unless `degraded`."""
        for supervisor in self.supervisors.values():
            self._group.start_soon(supervisor.run, degraded)
        for supervisor in self.supervisors.values():
            await supervisor.tried.wait()
        if not degraded:
            for name, supervisor in self.supervisors.items():
                if supervisor.down is not None:
                    raise supervisor.down.at(bus=name)

    async def acquire(self, *names: str) -> None:
        self.full_names(names)

    async def release(self, *names: str) -> None:
        self.full_names(names)

    async def reload(self, *, force: bool = False) -> Reload:
        if self.path is None:
            raise NotSupported("this rig was not opened from a file, so there is none to read again")
        config = load_config(self.path)  # an invalid file raises here, before anything has changed
        if self._reloading is not None and not self._reloading.done():
            raise Busy("the config is being read again already: wait until that is done")
        self._reloading = asyncio.create_task(self._reload(config, force))
        return await asyncio.shield(self._reloading)  # a caller that is cancelled does not stop it half-way

    async def _reload(self, config: Config, force: bool) -> Reload:
        await asyncio.gather(*self._stopping)
        wanted = [name for name in config.buses if not self._only or name in self._only]
        same = [name for name in wanted if name in self.buses and config.has_same_line(name, self.config)]
        differing = [name for name in same if config.buses[name] != self.config.buses[name]]
        updated = tuple(name for name in differing if self.buses[name].use_options(config.buses[name]))
        kept = {name for name in same if name in updated or name not in differing}
        gone = {name: supervisor for name, supervisor in self.supervisors.items() if name not in kept}
        if reason := why_not_to_close(gone, force=force):
            for name in updated:
                self.buses[name].use_options(self.config.buses[name])
            raise Busy(reason)
        self.left.update(await self._leave(gone.values()))
        await asyncio.gather(*map(self._end, gone.values()))
        latched = self.stopped
        self.config = config
        self.supervisors = {name: self.supervisors[name] if name in kept else self._supervisor(name, config) for name in wanted}
        self._index()
        new = [name for name in wanted if name not in kept]
        for name in new:
            self.buses[name].stops.latched = latched
            self._group.start_soon(self.supervisors[name].run, True)
        added, changed = (tuple(name for name in new if (name in gone) is again) for again in (False, True))
        report = Reload(added, changed, tuple(name for name in gone if name not in wanted), updated)
        self._event(EventName.RELOADED, **asdict(report))
        return report

    @staticmethod
    async def _end(supervisor: BusSupervisor) -> None:
        supervisor.scope.cancel()
        await supervisor.close()

    def to_leave(self) -> dict[str, str]:
        """The servos whose torque may be on because of us, by full name, and what the end does to each: hold, limp or park."""
        return {f"{name}/{each.name}": each.options.on_exit for name, bus in self.buses.items() for each in bus.stops.to_leave()}

    async def leave(self) -> None:
        """Apply the exit policies, on all buses at once; `left` then says how each servo was left."""
        reloading = () if self._reloading is None else (self._reloading,)
        await asyncio.gather(*self._stopping, *reloading, return_exceptions=True)
        self.left.update(await self._leave(self.supervisors.values()))

    @staticmethod
    async def _leave(supervisors: Iterable[BusSupervisor]) -> dict[str, StopReport]:
        reports = await asyncio.gather(*(supervisor.leave() for supervisor in supervisors))
        return {name: report for part in reports for name, report in part.items()}

    async def close(self) -> None:
        """Close every line, once nothing opens them again."""
        await asyncio.gather(*(supervisor.close() for supervisor in self.supervisors.values()))

    # Motion

    async def send_all(self, goals: Mapping[str, Goal], *, together: bool = False, confirm: bool = False) -> dict[str, Outcome]:
        parts: dict[str, dict[str, Goal]] = {}
        for name, goal in goals.items():
            bus, servo = self._names.get(name) or self._names[self.full_name(name)]
            part = parts.get(bus)
            if part is None:
                part = parts[bus] = {}
            elif servo in part:
                raise InvalidRequest(f"{self.full_name(name)} is named twice: give it one goal; nothing was sent")
            part[servo] = goal
        checked = {bus: self.buses[bus].motion.check(part) for bus, part in parts.items()}
        futures = {
            f"{bus}/{servo}": future
            for bus, part in checked.items()
            for servo, future in self.buses[bus].motion.put(part, together=together, confirm=confirm).items()
        }
        return await outcomes(futures)

    def shortened(self, name: str, goal: Goal, age: float) -> Goal:
        """The `goal` for the servo `name` of a call made `age` seconds ago: it has that much less time. Raises GoalExpired."""
        bus, servo = self.bus_of(name)
        within = bus.motion.start_within(servo, goal)
        if age < within:
            return replace(goal, start_within=within - age)
        late = f"the call was on its way for {age:.1f} s, and its goal was to start within {within:g} s"
        raise GoalExpired(f"{late}: nothing was sent; retry", bus=bus.name, servo=servo)

    async def send(self, name: str, goal: Goal, *, confirm: bool = False) -> Outcome:
        bus, servo = self.bus_of(name)
        return await bus.motion.send(servo, goal, confirm=confirm)

    async def enable(self, *names: str) -> None:
        await self._each(names, lambda bus, servo: bus.motion.enable(servo))

    async def disable(self, *names: str) -> None:
        await self._each(names, lambda bus, servo: bus.motion.disable(servo))

    async def stop(self) -> dict[str, StopReport]:
        self._set_latch(latched=True)  # from the call on, before another goal can leave
        stopping = self._track(self._stop_all())
        return await asyncio.shield(stopping)  # a caller that is cancelled does not end it

    async def _stop_all(self) -> dict[str, StopReport]:
        self._event(EventName.ESTOP)
        parking = [
            (supervisor, record) for supervisor in self.supervisors.values() for record in supervisor.enabled("on_estop", "park")
        ]
        reports = await asyncio.gather(*(bus.stops.stop() for bus in self.buses.values()))
        for supervisor, record in parking:
            self._track(supervisor.park(record))
        return {f"{bus}/{servo}": report for bus, part in zip(self.buses, reports, strict=True) for servo, report in part.items()}

    def _track(self, coroutine: Coroutine[Any, Any, R]) -> asyncio.Task[R]:
        task = asyncio.create_task(coroutine)
        self._stopping.add(task)
        task.add_done_callback(self._stopping.discard)
        return task

    async def clear(self) -> tuple[str, ...]:
        if self._stopping:
            raise Busy("servos are still being stopped or parked: clear when they are at rest")
        self._set_latch(latched=False)
        owed = tuple(f"{name}/{servo}" for name, bus in self.buses.items() for servo in bus.stops.owed)
        self._event(EventName.ESTOP_CLEARED, owed=owed)
        return owed

    def _set_latch(self, *, latched: bool) -> None:
        for bus in self.buses.values():
            bus.stops.latched = latched
        if self._latch is not None:
            self._latch.set(latched=latched)

    @property
    def stopped(self) -> bool:
        return any(bus.stops.latched for bus in self.buses.values())

    async def settle(self, *names: str, tolerance: float | None = None, timeout: float = 10.0) -> Snapshot:
        full = self.full_names(names)
        located = map(self.bus_of, full)
        waits = (bus.motion.settle(servo, tolerance=tolerance, timeout=timeout) for bus, servo in located)
        return dict(zip(full, await asyncio.gather(*waits), strict=True))

    async def abandon(self, names: Iterable[str]) -> dict[str, StopReport]:
        """Let servos do their `on_lost_client`, because the client that moved them is lost.

        Args:
            names: Full names; of these, the servos that are enabled.

        Returns: What was done to each, by full name, once it is done, parking too.
        """
        parts: dict[str, set[str]] = {}
        for name in names:
            bus, servo = self._names[name]
            parts.setdefault(bus, set()).add(servo)
        done = await asyncio.gather(*(self._track(self._abandon(self.supervisors[bus], part)) for bus, part in parts.items()))
        return {f"{bus}/{servo}": report for bus, part in zip(parts, done, strict=True) for servo, report in part.items()}

    @staticmethod
    async def _abandon(supervisor: BusSupervisor, servos: Collection[str]) -> dict[str, StopReport]:
        parking = [record for record in supervisor.enabled("on_lost_client", "park") if record.name in servos]
        reports = await supervisor.bus.stops.abandon(servos)
        parked = await asyncio.gather(*map(supervisor.park, parking))
        return reports | {record.name: report for record, report in zip(parking, parked, strict=True)}

    # Reading

    async def read(self, name: str, *, max_age: float | None = None) -> State:
        bus, servo = self.bus_of(name)
        return await bus.read(servo, max_age)

    def state(self, name: str) -> State:
        """The last known state of the servo `name`, without a turn."""
        bus, servo = self.bus_of(name)
        return bus.state(servo)

    def recent(self, name: str, max_age: float) -> State | None:
        """The state of `name` that is at most `max_age` seconds old; None: `read` needs a turn."""
        bus, servo = self.bus_of(name)
        return bus.state(servo) if bus.is_fresh(servo, max_age) else None

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
        progress: Callable[[int, int, ScanHit | None], None] | None = None,
    ) -> list[ScanHit]:
        service = self._bus(bus)
        every = PROTOCOLS[service.options.protocol].scan_ids
        hits = []
        async for asked, count, identity in scan(
            service, list(baudrates) or [service.options.baudrate], list(ids) or list(every)
        ):
            hit = None if identity is None else ScanHit(bus, *identity)
            if hit:
                hits.append(hit)
            if progress:
                progress(asked, count, hit)
        return hits

    async def set_id(self, bus: str, node: int, new: int, *, save: bool = False) -> Change:
        return await self._bus(bus).commission(node, lambda plans: plans.set_id(node, new, save=save))

    async def set_baudrate(self, bus: str, node: int, baudrate: int, *, save: bool = False) -> Change:
        return await self._bus(bus).commission(node, lambda plans: plans.set_baudrate(node, baudrate, save=save))

    async def command(self, bus: str, node: int, name: str, value: int | None = None) -> tuple[str, ...]:
        return await self._bus(bus).commission(node, lambda plans: plans.command(node, name, value))

    def _bus(self, name: str) -> BusService:
        if name not in self.buses:
            raise UnknownName(f"no bus {name!r}: there are {', '.join(self.buses)}")
        return self.buses[name]

    def stats(self) -> dict[str, Any]:
        return {name: bus.snapshot() for name, bus in self.buses.items()}

    async def _each(self, names: Iterable[str], verb: Callable[[BusService, str], Awaitable[None]]) -> None:
        """Call the verb for every servo, whatever happens to another."""
        full = self.full_names(names)
        results = await asyncio.gather(*(verb(*self.bus_of(name)) for name in full), return_exceptions=True)
        raise_failures(dict(zip(full, results, strict=True)))

    def _event(self, name: EventName, **fields: Any) -> None:
        (log.info if name in QUIET else log.warning)(name, **fields)
        self.event_source.publish(Event(name, asyncio.get_running_loop().time(), fields))

    def events(self) -> EventStream:
        return self.event_source.stream()


@asynccontextmanager
async def open_rig(
    config: str | Path | Config,
    *,
    buses: Collection[str] = (),
    degraded: bool = False,
    trace: Trace | None = None,
    latch: LatchFile | None = None,
) -> AsyncIterator[LocalRig]:
    """Own the ports of a config until the context ends; then each servo enabled here is left as its `on_exit` says.

    Args:
        config: Path of the YAML file, or a loaded Config.
        buses: Names of the buses to open; none: all.
        degraded: True: a port that cannot be opened is waited for; False: it raises.
        trace: Called with (bus, sent, bytes, monotonic seconds) for everything on the wire, both ways.
        latch: Where the e-stop's latch is kept through a restart; None: it ends with the context.

    Returns: A context manager whose value is a LocalRig.
    Raises: ConfigError, PortMissing, PortBusy, PortDenied, LinkDown.
    """
    path = None if isinstance(config, Config) else Path(config)
    setup = config if isinstance(config, Config) else load_config(config)
    failure: BaseException | None = None
    async with anyio.create_task_group() as supervisors:
        rig = LocalRig(setup, supervisors, buses, trace, path, latch)
        try:
            await rig.start(degraded=degraded)
            yield rig
        except BaseException as error:  # noqa: BLE001 - raised again below, outside the group, which would wrap it
            failure = error
        cancelled = await uncancelled(rig.leave())
        supervisors.cancel_scope.cancel()
    cancelled = await uncancelled(rig.close()) or cancelled
    if failure or cancelled:
        raise failure or cancelled  # type: ignore[misc]
