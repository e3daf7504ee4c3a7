"""Everything that moves on one bus: goals, enable, disable, e-stop, and what is left behind at the end.

Refusals come first and cost no byte. What an e-stop or a restart has ended is never sent again.
"""

from __future__ import annotations

import asyncio
import itertools
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from servobus.bus.limits import check_goal
from servobus.bus.records import ServoRecord
from servobus.engine.coalescer import Ticket
from servobus.engine.health import Condition, Node
from servobus.engine.queue import Job
from servobus.errors import Busy, DeviceError, EStopped, LeaseHeld, LinkDown, NotEnabled, ServobusError, SettleTimeout
from servobus.values import Goal, Outcome, ServoGoal, State, StopReport, StopTarget

if TYPE_CHECKING:
    from servobus.bus.service import BusService

MIN_TTL = 0.2
"""Seconds a goal may wait for its first byte, unless two learned turns take longer."""
FRESH = 0.1
"""Seconds for which a position is good enough to be held at once by an e-stop."""
SESSION = "a scan or commissioning session has this bus: wait until it ends"
SETTLE_PERIOD = 0.02
_batches = itertools.count(1)


class Motion:
    """Goals and stops of one bus."""

    def __init__(self, bus: BusService) -> None:
        self._bus = bus
        self.latched = False
        """The e-stop holds: motion and enable are refused until it is cleared."""
        self.leaving = False
        """The rig is being left: nothing new is begun."""
        self.enabling: set[str] = set()
        """Servos that are being enabled just now."""

    def check(self, goals: Mapping[str, Goal]) -> dict[str, Goal]:
        """The goals to send, clamped where a servo says so. Raises what refuses any of them; nothing is sent."""
        self.refuse()
        checked = {}
        for servo, goal in goals.items():
            record = self._bus.records[servo]
            if not record.enabled:
                raise NotEnabled("the servo is not enabled: enable it first", bus=self._bus.name, servo=servo)
            try:
                checked[servo] = check_goal(servo, goal, record.options, record.reference())
                self._bus.driver.check_goal(ServoGoal(servo, checked[servo], record.reference()))
            except ServobusError as error:
                raise error.at(bus=self._bus.name) from None
            if checked[servo] != goal:
                self._bus.stats.counts["goals_clamped"] += 1
                self._bus.event("goal_clamped", bus=self._bus.name, servo=servo, asked=goal.value, applied=checked[servo].value)
        return checked

    def put(self, goals: Mapping[str, Goal], *, together: bool, confirm: bool) -> dict[str, asyncio.Future[Outcome]]:
        """Checked goals on their way; each future ends with its outcome or its error."""
        bus = self._bus
        batch = next(_batches) if together else None
        futures = {}
        for servo, goal in goals.items():
            future: asyncio.Future[Outcome] = bus.loop.create_future()
            ticket = self._ticket(bus.records[servo], goal, future)
            ticket.batch, ticket.confirm, ticket.gone = batch, confirm, future.cancelled
            bus.stats.counts["goals"] += 1
            self._pace(ticket)
            bus.scheduler.coalescer.put(ticket)
            futures[servo] = future
        if bus.master.up:
            bus.master.goals_waiting()
        else:
            bus.scheduler.coalescer.drop(lambda servo: LinkDown("the line is down: nothing was sent", bus=bus.name, servo=servo))
        return futures

    def _pace(self, ticket: Ticket) -> None:
        """Where the servo keeps no speed, the host does; any way it was being led on ends."""
        profile, speed = self._bus.scheduler.profile, self._bus.driver.host_speed(ticket.goal)
        if speed is None:
            profile.drop({ticket.servo})
        else:
            profile.begin(ticket, speed, self._bus.clock())

    def _ticket(self, record: ServoRecord, goal: Goal, future: asyncio.Future[Outcome]) -> Ticket:
        now = self._bus.clock()
        patience = 2 * (record.node.deadline + self._bus.line.traits.latency)
        ttl = goal.start_within or record.options.ttl or max(MIN_TTL, patience)
        position = record.position(now, FRESH)
        start = record.reference() if position is None else position
        return Ticket(ServoGoal(record.name, goal, start), record.node.id, now + ttl, partial(self._settle, record, goal, future))

    def _settle(self, record: ServoRecord, goal: Goal, future: asyncio.Future[Outcome], result: Outcome | Exception) -> None:
        """A ticket has ended."""
        counts = self._bus.stats.counts
        if isinstance(result, Outcome):
            if result is not Outcome.SUPERSEDED and goal.kind == "position":
                record.setpoint = goal.value
            counts[f"goals_{result}"] += 1
            if not future.done():
                future.set_result(result)
            return
        counts["goals_failed"] += 1
        if not future.done():
            future.set_exception(
                result.at(bus=self._bus.name, servo=record.name) if isinstance(result, ServobusError) else result
            )

    async def enable(self, servo: str) -> None:
        self.refuse()
        record = self._bus.records[servo]
        generation = record.generation
        self.enabling.add(servo)
        try:
            if record.identity is None:
                await self._bus.identify(servo)
                self.refuse()
            self._set_enabled(record, False)
            record.touched = True  # also when this is cancelled or fails half-way
            present = await self._bus.perform(self._bus.driver.enable(servo), record.node.id, servo=servo, motion=True)
        finally:
            self.enabling.discard(servo)
        if self.latched or self.leaving:
            raise EStopped("the e-stop came while it was being enabled", bus=self._bus.name, servo=servo)
        if record.generation != generation:
            raise NotEnabled("it was disabled while it was being enabled", bus=self._bus.name, servo=servo)
        record.setpoint = present
        self._bus.scheduler.profile.forget(servo)
        self._set_enabled(record, True)

    async def disable(self, servo: str) -> None:
        record = self._bus.records[servo]
        if self._bus.scheduler.session is not None:
            raise Busy(SESSION, bus=self._bus.name, servo=servo)
        self._bus.scheduler.drop_goals(self._disabled, {servo})
        self._disable(record)
        report = await self._bus.perform(self._bus.driver.disable(servo), record.node.id, servo=servo, urgent=True)
        if not report.confirmed:
            raise DeviceError(f"torque off was written and not confirmed: {report.detail}", bus=self._bus.name, servo=servo)
        self._disable(record)
        record.touched = False

    async def stop(self) -> dict[str, StopReport]:
        """E-stop for this bus: everything that moves is dropped, every servo stops as its `on_estop` says (park: holds first)."""
        self.latched = True
        return await self._stop(lambda record: record.options.on_estop, list(self._bus.records.values()), estop=True)

    async def limp(self, servos: Sequence[str]) -> dict[str, StopReport]:
        """Torque off for these, ahead of everything that waits."""
        records = [self._bus.records[servo] for servo in servos]
        return await self._stop(lambda _: "limp", records, estop=self.latched or self.leaving)

    async def abandon(self, servos: Collection[str]) -> dict[str, StopReport]:
        """Whoever moved these is gone: those that are enabled stop as their `on_lost_client` says (park: hold first), between two
        plans of the others."""
        gone = LeaseHeld("the client that moved it is gone: nothing was sent")
        self._bus.scheduler.drop_goals(lambda servo: gone.at(bus=self._bus.name, servo=servo), servos)
        records = [self._bus.records[servo] for servo in servos if self._bus.records[servo].enabled]
        return await self._stop(lambda record: record.options.on_lost_client, records, estop=False)

    async def _stop(
        self, kind_of: Callable[[ServoRecord], str], servos: Sequence[ServoRecord], *, estop: bool
    ) -> dict[str, StopReport]:
        now = self._bus.clock()
        # Those that answer come first: a dead one must not hold up a live one.
        records = sorted(servos, key=lambda record: record.node.condition is not Condition.ONLINE)
        targets = [
            StopTarget(
                record.name,
                "limp" if kind_of(record) == "limp" else "hold",
                enabled=record.enabled,
                position=record.position(now, FRESH),
                reachable=record.node.condition is not Condition.OFFLINE,
            )
            for record in records
        ]
        if not targets:
            return {}
        future: asyncio.Future[dict[str, StopReport]] = self._bus.loop.create_future()
        job = Job(future, math.inf, plan=self._bus.driver.stop(targets), node=records[0].node.id, tries=1, motion=not estop)
        for record, target in zip(records, targets, strict=True):
            record.setpoint = None
            if target.kind == "limp":
                self._disable(record)  # before anything is said: no goal may leave behind the torque off
        try:
            self._bus.master.submit_stop(job, estop=estop)
            reports = await future
        except ServobusError as error:
            if not future.done():
                job.fail(error)
                future.exception()
            reports = {target.servo: StopReport(target.kind, False, False, str(error)) for target in targets}
        for record, target in zip(records, targets, strict=True):
            if target.kind == "limp":
                record.touched = record.touched and not reports[record.name].confirmed
        return {record.name: reports[record.name] for record in servos}

    async def settle(self, servo: str, *, tolerance: float | None, timeout: float, parking: bool = False) -> State:
        """Until it stands at its setpoint. Raises SettleTimeout; EStopped and NotEnabled when it will not get there any more."""
        bus, record = self._bus, self._bus.records[servo]
        moving = record.enabled
        near = bus.tolerance(servo) if tolerance is None else tolerance
        end = bus.clock() + timeout
        while True:
            self._refuse_to_settle(record, moving, parking)
            state = await bus.read(servo, SETTLE_PERIOD)
            self._refuse_to_settle(record, moving, parking)  # a stop or a restart meanwhile has changed its setpoint
            there = record.setpoint is None or (state.position is not None and abs(state.position - record.setpoint) <= near)
            if there and not state.moving and not bus.scheduler.profile.leads(servo):
                return state
            if bus.clock() >= end:
                raise SettleTimeout(
                    f"it did not settle within {timeout:g} s: it stands at {state.position}, its goal is {record.setpoint}",
                    bus=bus.name,
                    servo=servo,
                )
            await asyncio.sleep(SETTLE_PERIOD)

    def _refuse_to_settle(self, record: ServoRecord, moving: bool, parking: bool) -> None:
        if self.latched and not parking:
            raise EStopped("the e-stop came before it stood at its goal", bus=self._bus.name, servo=record.name)
        if moving and not record.enabled:
            raise NotEnabled(
                "it was disabled, or has restarted, before it stood at its goal", bus=self._bus.name, servo=record.name
            )

    async def park(self, servo: str) -> StopReport:
        """To the park pose within `park_timeout`, then limp, even if it does not get there. The e-stop it serves lets it pass."""
        record = self._bus.records[servo]
        options = record.options
        detail = ""
        try:
            # Whether it still is as we left it: one that has restarted is limp, and must not be moved.
            await self._bus.perform(self._bus.scheduler.recovery(record.node), record.node.id, servo=servo, urgent=True)
            if not record.enabled:
                return StopReport("none", False, True, "it was disabled, or has restarted")
            assert options.park_pose is not None
            goal = Goal("position", options.park_pose)
            await self.put({servo: goal}, together=False, confirm=False)[servo]
            await self.settle(servo, tolerance=None, timeout=options.park_timeout, parking=True)
        except ServobusError as error:
            detail = f"not at its park pose: {error.message}"
        report = (await self.limp([servo]))[servo]
        self._bus.records[servo].touched = False  # its report tells; a hold on the way out would only stiffen what should be limp
        return replace(report, action="park", confirmed=report.confirmed and not detail, detail=detail or report.detail)

    def refuse(self) -> None:
        if self.latched:
            raise EStopped("the e-stop is latched: `clear` releases it", bus=self._bus.name)
        if self._bus.scheduler.session is not None:
            raise Busy(SESSION, bus=self._bus.name)
        if self.leaving:
            raise NotEnabled("the rig is being left: its servos stop as their on_exit says, nothing was sent", bus=self._bus.name)

    def disable_restarted(self, node: Node) -> list[ServoRecord]:
        """The node has lost what enable() wrote: its servos that were enabled, now disabled."""
        restarted = [record for record in self._bus.on(node) if record.enabled]
        for record in restarted:
            record.setpoint = None
            self._set_enabled(record, False)
        self._bus.scheduler.drop_goals(self._disabled, {record.name for record in self._bus.on(node)})
        return restarted

    async def leave(self) -> dict[str, StopReport]:
        """What `on_exit` says, hold and limp, for each servo whose torque may be on because of us; park is the rig's."""
        return await self._stop(lambda record: record.options.on_exit, self.to_leave(), estop=True)

    def to_leave(self) -> list[ServoRecord]:
        """The servos whose torque may be on because of us."""
        return [record for record in self._bus.records.values() if record.touched]

    def _disable(self, record: ServoRecord) -> None:
        record.generation += 1
        self._set_enabled(record, False)

    def _set_enabled(self, record: ServoRecord, enabled: bool) -> None:
        record.enabled = enabled
        record.node.enabled = tuple(other.name for other in self._bus.on(record.node) if other.enabled)

    def _disabled(self, servo: str) -> ServobusError:
        return NotEnabled("the servo was disabled before this goal could leave", bus=self._bus.name, servo=servo)
