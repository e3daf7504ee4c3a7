"""The verbs of one bus: checks, records and the plans of its driver, on top of the engine.

Refusals happen here, before anything is queued: limits, enable, e-stop, exclusive sessions. Nothing is written at
start, a restarted servo is disabled and its goal is not sent again.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping
from contextlib import asynccontextmanager
from typing import Any, TypeVar, cast

from servobus.bus.discovery import Discovery
from servobus.bus.master import BusMaster
from servobus.bus.motion import Motion
from servobus.bus.records import ServoRecord
from servobus.engine.engine import Runner
from servobus.engine.health import Condition, Health, Node
from servobus.engine.line import EchoFilter, Line
from servobus.engine.queue import TRIES, Job
from servobus.engine.scheduler import Scheduler
from servobus.engine.stats import BusStats
from servobus.errors import Busy, DeviceError, NotSupported, ServobusError
from servobus.protocols.base import Codec, Commissioning, Driver, LineTraits, Plan, Request
from servobus.protocols.options import BusOptions
from servobus.timers import clock_of
from servobus.values import Identity, State, Update

R = TypeVar("R")

PATIENCE = 2.0
"""Seconds a request may wait for its turn."""
TOLERANCE_STEPS = 10
DOWN_PAUSE = 0.02
"""A caller that asks again and again while the line is down is answered this slowly, so that it does not burn the core."""

Event = Callable[..., None]


class BusService:
    """One bus. `event(name, **fields)` is told what a person or a log should know."""

    def __init__(self, name: str, options: BusOptions, driver: Driver, codec: Codec, traits: LineTraits, event: Event) -> None:
        self.name = name
        self.options = options
        self.driver = driver
        self.event = event
        self.records: dict[str, ServoRecord] = {}
        self.loop = asyncio.get_running_loop()
        self.clock = clock_of(self.loop)
        greatest = {} if options.timeout_ms is None else {"greatest_deadline": options.timeout_ms / 1000}
        self.health = Health(set(driver.nodes.values()), changed=self._changed, **greatest)
        self.stats = BusStats(self.clock())
        self.scheduler = Scheduler(
            driver,
            self.health,
            on_update=self._polled,
            on_restart=self._restarted,
            on_cut=self._cut,
            cycle=options.rate_of_goals,
        )
        self.line = Line(traits)
        self.line.spread = options.spread
        if options.echo == "on":
            self.line.echo = EchoFilter()
        self.master = BusMaster(name, codec, Runner(name, self.scheduler, self.health, self.stats), self.line)
        servos: Mapping[str, Any] = getattr(options, "servos")  # noqa: B009 - each protocol narrows it to its own class
        for servo, entry in servos.items():
            self.records[servo] = ServoRecord(servo, entry, self.health.node(driver.nodes[servo]))
        self.motion = Motion(self)
        self.discovery = Discovery(self)

    # Start and end

    async def start(self) -> None:
        """After the line was opened: quiet, identify, read; then poll. Writes nothing. A missing servo is an event, no error."""
        if self.options.echo == "auto":
            await self.discovery.probe_echo()
        self.driver.use_traits(self.line.traits)
        await self.discovery.identify_all()
        if self.master.up and self.motion.latched:
            await self.motion.stop()  # asked for while the line was down
        if self.master.up:
            self.scheduler.polls.set(self.driver.polls(self.options.poll.rates()), self.clock())
            self.master.goals_waiting()

    # Requests and plans

    def ask(
        self, request: Request[R], *, servo: str | None = None, urgent: bool = False, session: object = None, tries: int = TRIES
    ) -> Coroutine[Any, Any, R]:
        """One request's value. Raises ReplyTimeout, DeviceError, LinkDown, Overloaded; `servo` is the place they name."""
        job = Job(
            self.loop.create_future(),
            self.clock() + PATIENCE,
            request=request,
            urgent=urgent,
            session=session,
            tries=tries,
        )
        return self._result(job, servo)

    def perform(
        self,
        plan: Plan[R],
        node: int,
        *,
        servo: str | None = None,
        motion: bool = False,
        urgent: bool = False,
        session: object = None,
    ) -> Coroutine[Any, Any, R]:
        """A plan's result; nothing but an e-stop comes between its frames. Raises as `ask`."""
        job = Job(
            self.loop.create_future(),
            self.clock() + PATIENCE,
            plan=plan,
            node=node,
            motion=motion,
            urgent=urgent,
            session=session,
        )
        return self._result(job, servo)

    async def _result(self, job: Job, servo: str | None) -> Any:
        try:
            self.master.submit(job)
        except ServobusError as error:
            job.fail(error)
            await asyncio.sleep(DOWN_PAUSE)
        try:
            return await cast("asyncio.Future[Any]", job.sink)
        except ServobusError as error:
            failure = error.at(bus=self.name, servo=servo)
        if isinstance(failure, DeviceError) and job.plan is None and servo is not None:
            failure = await self._explained(failure, servo)
        raise failure

    async def _explained(self, error: DeviceError, servo: str) -> ServobusError:
        """With what the servo says about its refusal, where it can be asked."""
        plan = self.driver.explain(servo, error)
        if plan is None:
            return error
        try:
            return (await self.perform(plan, self.driver.nodes[servo], servo=servo)).at(bus=self.name, servo=servo)
        except ServobusError:
            return error

    def set_baudrate(self, baudrate: int) -> None:
        """For an exclusive session."""
        if baudrate != self.line.traits.baudrate:
            self.master.set_baudrate(baudrate)

    # Reading

    async def read(self, servo: str, max_age: float | None = None) -> State:
        if max_age is None or not self.knows(servo, max_age):
            self._updated(await self.ask(self.driver.read_state(servo), servo=servo))
        return self.state(servo)

    def knows(self, servo: str, max_age: float) -> bool:
        """The newest of what is known is no older than this (s)."""
        heard = self.records[servo].updated_at
        return heard is not None and self.clock() - heard <= max_age

    def state(self, servo: str) -> State:
        record = self.records[servo]
        return record.state(self.clock(), self.driver.fault_names(servo, record.node.status))

    def tolerance(self, servo: str) -> float:
        """What counts as arrived, in the servo's unit, when nobody says."""
        return TOLERANCE_STEPS * self.driver.step(servo)

    def snapshot(self) -> dict[str, Any]:
        """Counters, latencies, and the condition of each node, for people and machines."""
        counts = self.stats.counts
        counts["drains"] = self.line.drains
        counts["collisions"] = self.line.echo.collisions if self.line.echo else 0
        counts["polls_missed"] = self.scheduler.polls.missed
        counts["goal_groups_split"] = self.scheduler.split_groups
        counts["goal_turns"] = self.scheduler.goal_turns
        nodes = {
            str(node.id): {"health": node.condition.value, "misses": node.misses, "deadline_ms": round(1e3 * node.deadline, 3)}
            for node in self.health.nodes.values()
            if node.configured
        }
        return {"up": self.master.up, "waiting": self.scheduler.waiting(), **self.stats.snapshot(self.clock()), "nodes": nodes}

    def read_register(self, servo: str, register: str, *, raw: bool = False) -> Coroutine[Any, Any, Any]:
        return self.ask(self.driver.read_register(servo, register, raw=raw), servo=servo)

    async def write_register(self, servo: str, register: str, value: Any, *, raw: bool = False, persist: bool = False) -> Any:
        enabled = [record.name for record in self.on(self.records[servo].node) if record.enabled]
        if persist and enabled:
            message = f"what stays is written to disabled servos only: disable {', '.join(enabled)} first"
            raise NotSupported(message, bus=self.name, servo=servo)
        plan = self.driver.write_register(servo, register, value, raw=raw, persist=persist)
        return await self.perform(plan, self.driver.nodes[servo], servo=servo)

    def ping(self, servo: str) -> Coroutine[Any, Any, int | None]:
        return self.ask(self.driver.ping(self.driver.nodes[servo]), servo=servo, urgent=True)

    async def identify(self, servo: str) -> Identity:
        identity = await self.perform(self.driver.identify(servo), self.driver.nodes[servo], servo=servo, urgent=True)
        self.discovery.identified(self.records[servo], identity)
        return identity

    # Sessions

    @asynccontextmanager
    async def exclusive(self) -> AsyncIterator[object]:
        """Polls, probes and goals rest, motion is refused, other requests wait. Raises Busy when one is open already."""
        self.motion.refuse()
        moving = [name for name, record in self.records.items() if record.enabled or name in self.motion.enabling]
        if moving:
            raise Busy(f"{', '.join(moving)} {'is' if len(moving) == 1 else 'are'} enabled: disable first", bus=self.name)
        self.scheduler.session = session = object()
        try:
            yield session
        finally:
            self.scheduler.session = None
            if self.master.up:
                self.master.goals_waiting()

    async def commission(self, node: int, plan_of: Callable[[Commissioning], Plan[R]]) -> R:
        """A change of id or rate, or a command, alone on the line and with nothing enabled. Raises NotSupported, LeaseHeld,
        LimitError, DeviceError."""
        if self.driver.commissioning is None:
            raise NotSupported("servos of this bus are given ids and rates with the vendor's tool", bus=self.name)
        plan = plan_of(self.driver.commissioning)
        async with self.exclusive() as session:
            return await self.perform(plan, node, urgent=True, session=session)

    # What the engine tells

    def _polled(self, result: dict[str, Update] | Exception) -> None:
        """A poll has ended; one that failed stands in its nodes' health."""
        if isinstance(result, dict):
            self.stats.counts["polled"] += len(result)
            self._updated(result)

    def _updated(self, result: dict[str, Update]) -> None:
        now = self.clock()
        for servo, fields in result.items():
            self.records[servo].update(fields, now)

    def _cut(self, servo: str, error: Exception) -> None:
        """The host led this servo, and a setpoint failed on the way."""
        self.event("motion_cut", bus=self.name, servo=servo, reason=str(error))

    def _restarted(self, node: Node) -> None:
        self.stats.counts["restarts"] += 1
        for record in self.motion.disable_restarted(node):
            self.event("servo_restarted", bus=self.name, servo=record.name, id=node.id)

    def _changed(self, node: Node, before: Condition) -> None:
        self.scheduler.node_changed(node)
        if not node.configured:
            return
        names = [record.name for record in self.on(node)]
        if Condition.OFFLINE in (node.condition, before):
            self.event(f"servo_{node.condition}", bus=self.name, servo=",".join(names), id=node.id)
        self.discovery.changed(node, self.clock())

    def on(self, node: Node) -> list[ServoRecord]:
        """The servos of a node."""
        return [record for record in self.records.values() if record.node is node]
