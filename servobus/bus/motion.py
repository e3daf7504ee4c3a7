"""Everything that moves on one bus: goals, enable, disable, e-stop, and what is left behind at exit.

Refusals come first and cost no byte. What an e-stop or a restart has ended is never sent again.

How `_stop` works, for an e-stop, a limp and a lost client alike:

1. Records of servos that go limp are disabled before anything is sent, so that no goal can follow the torque off.
2. Nodes that are online are asked before the others: a dead servo must not hold up a live one.
3. A servo holds at its present position where that is fresh, else the driver reads it first.
4. The report says for each servo what was written and what was confirmed by reading it back. An error of the whole stop
   (the line is down) becomes a report for each servo.
"""

from __future__ import annotations

import asyncio
import itertools
import math
from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial

from servobus.bus.limits import check_goal
from servobus.bus.records import ServoRecord
from servobus.bus.requests import BusParts, Requests
from servobus.engine.coalescer import Ticket
from servobus.engine.health import OFFLINE, ONLINE, Node
from servobus.engine.job import Job, JobKind
from servobus.engine.stats import Counter
from servobus.errors import Busy, DeviceError, EStopped, LeaseHeld, LinkDown, NotEnabled, ServobusError, SettleTimeout
from servobus.values import EventName, Goal, Identity, Outcome, ServoGoal, State, StopReport, StopTarget

MIN_START_WITHIN = 0.2
"""Seconds a goal may wait for its first byte, unless two learned turns take longer."""
FRESH = 0.1
"""Seconds for which a position is good enough to be held at once by an e-stop."""
SESSION = "a scan or commissioning session has this bus: wait until it ends"
SETTLE_PERIOD = 0.02
TOLERANCE_STEPS = 10
_batches = itertools.count(1)
# Looking a member up in its enum is a Python call, and these are needed for every goal.
GOALS, SUPERSEDED = Counter.GOALS, Outcome.SUPERSEDED


class Motion:
    """Goals and stops of one bus."""

    def __init__(
        self,
        parts: BusParts,
        requests: Requests,
        *,
        identify: Callable[[str], Awaitable[Identity]],
        read: Callable[[str, float | None], Awaitable[State]],
    ) -> None:
        self._parts = parts
        self._requests = requests
        self._identify = identify
        self._read = read
        self._loop = asyncio.get_running_loop()
        self.latched = False
        """The e-stop holds: motion and enable are refused until it is cleared."""
        self.leaving = False
        """The rig is being left: nothing new begins."""
        self.enabling: set[str] = set()
        """Servos whose enable is under way."""

    def refuse(self) -> None:
        """Raise what refuses all motion on this bus now: EStopped, Busy, NotEnabled."""
        if self.latched:
            raise EStopped("the e-stop is latched: `clear` releases it", bus=self._parts.name)
        if self._parts.scheduler.session is not None:
            raise Busy(SESSION, bus=self._parts.name)
        if self.leaving:
            message = "the rig is being left: its servos stop as their on_exit says, nothing was sent"
            raise NotEnabled(message, bus=self._parts.name)

    # Goals

    def check(self, goals: Mapping[str, Goal]) -> dict[str, ServoGoal]:
        """Return the goals to send, clamped where a servo says so. Raises what refuses any of them; nothing is sent."""
        self.refuse()
        now = self._parts.clock()
        return {servo: self._check(servo, goal, now) for servo, goal in goals.items()}

    def _check(self, servo: str, goal: Goal, now: float) -> ServoGoal:
        parts = self._parts
        record = parts.records[servo]
        if not record.enabled:
            raise NotEnabled("the servo is not enabled: enable it first", bus=parts.name, servo=servo)
        try:
            limited = check_goal(servo, goal, record.options, record.reference())
            checked = ServoGoal(servo, limited, record.start(now, FRESH))
            checked.packed = parts.driver.check_goal(checked)
        except ServobusError as error:
            raise error.at(bus=parts.name) from None
        if limited is not goal:
            parts.stats.counts[Counter.GOALS_CLAMPED] += 1
            parts.emit(EventName.GOAL_CLAMPED, bus=parts.name, servo=servo, asked=goal.value, applied=limited.value)
        return checked

    def put(self, goals: Mapping[str, ServoGoal], *, together: bool, confirm: bool) -> dict[str, asyncio.Future[Outcome]]:
        """Send checked goals; each future ends with its outcome or its error."""
        batch, now = next(_batches) if together else None, self._parts.clock()
        futures = {servo: self._put(goal, now, batch, confirm) for servo, goal in goals.items()}
        self._drop_if_down()
        return futures

    def send(self, servo: str, goal: Goal, *, confirm: bool) -> asyncio.Future[Outcome]:
        """Check one goal and send it; the future ends with its outcome or its error."""
        self.refuse()
        now = self._parts.clock()
        future = self._put(self._check(servo, goal, now), now, None, confirm)
        self._drop_if_down()
        return future

    def _put(self, goal: ServoGoal, now: float, batch: int | None, confirm: bool) -> asyncio.Future[Outcome]:
        parts = self._parts
        record = parts.records[goal.servo]
        future: asyncio.Future[Outcome] = self._loop.create_future()
        expires = now + (goal.goal.start_within or record.options.ttl or self._default_start_within(record))
        done = partial(self._ended, record, goal.goal, future)
        ticket = Ticket(goal, record.node.id, expires, done, batch, confirm, future.cancelled)
        parts.stats.counts[GOALS] += 1
        speed = parts.driver.host_speed(goal)
        start = record.setpoint if record.ramped else goal.start
        record.ramped = speed is not None
        parts.scheduler.put_goal(ticket, now, speed=speed, start=start)
        return future

    def _default_start_within(self, record: ServoRecord) -> float:
        two_turns: float = 2 * (record.node.reply_allowance_s + self._parts.line.traits.latency)
        return two_turns if two_turns > MIN_START_WITHIN else MIN_START_WITHIN

    def _drop_if_down(self) -> None:
        parts = self._parts
        if not parts.master.up:
            parts.scheduler.drop_goals(lambda servo: LinkDown("the line is down: nothing was sent", bus=parts.name, servo=servo))

    def _ended(self, record: ServoRecord, goal: Goal, future: asyncio.Future[Outcome], result: Outcome | Exception) -> None:
        """A ticket has ended."""
        counts = self._parts.stats.counts
        if isinstance(result, Outcome):
            counts[OUTCOME_COUNTERS[result]] += 1
            if result is not SUPERSEDED and goal.kind == "position":
                record.goal = goal.value
                if not record.ramped:
                    record.setpoint = goal.value
            if not future.done():
                future.set_result(result)
            return
        counts[Counter.GOALS_FAILED] += 1
        if not future.done():
            error = result.at(bus=self._parts.name, servo=record.name) if isinstance(result, ServobusError) else result
            future.set_exception(error)

    def setpoint_sent(self, servo: str, setpoint: float) -> None:
        """The host's ramp of this servo has gone on to this setpoint."""
        record = self._parts.records[servo]
        if record.ramped:
            record.setpoint = setpoint

    # Enable and disable

    async def enable(self, servo: str) -> None:
        """Set the goal to the present position, then switch torque on. Raises EStopped, Busy, NotEnabled, DeviceError."""
        self.refuse()
        record = self._parts.records[servo]
        generation = record.generation
        self.enabling.add(servo)
        try:
            if record.identity is None:
                await self._identify(servo)
                self.refuse()
            record.enabled = False
            record.touched = True  # also when this is cancelled or fails half-way
            plan = self._parts.driver.enable(servo)
            present = await self._requests.perform(plan, record.node.id, servo=servo, kind=JobKind.MOTION)
        finally:
            self.enabling.discard(servo)
        if self.latched or self.leaving:
            raise EStopped("the e-stop came while the servo was being enabled", bus=self._parts.name, servo=servo)
        if record.generation != generation:
            raise NotEnabled("the servo was disabled while it was being enabled", bus=self._parts.name, servo=servo)
        record.hold_at(present)
        self._parts.scheduler.ramps.drop({servo})
        record.enabled = True

    async def disable(self, servo: str) -> None:
        """Switch torque off and read it back. Raises Busy in an exclusive session, DeviceError where it is not confirmed."""
        record = self._parts.records[servo]
        if self._parts.scheduler.session is not None:
            raise Busy(SESSION, bus=self._parts.name, servo=servo)
        self._parts.scheduler.drop_goals(self._disabled, {servo})
        _disable(record)
        plan = self._parts.driver.disable(servo)
        report = await self._requests.perform(plan, record.node.id, servo=servo, even_if_offline=True)
        if not report.confirmed:
            message = f"torque off was written and not confirmed: {report.detail}"
            raise DeviceError(message, bus=self._parts.name, servo=servo)
        _disable(record)
        record.touched = False

    def disable_restarted(self, node: Node) -> list[ServoRecord]:
        """Disable the servos of a node that lost what `enable` wrote; return those that were enabled."""
        records = self._parts.on(node)
        restarted = [record for record in records if record.enabled]
        for record in restarted:
            record.hold_at(None)
            record.enabled = False
        self._parts.scheduler.drop_goals(self._disabled, {record.name for record in records})
        return restarted

    def _disabled(self, servo: str) -> ServobusError:
        return NotEnabled("the servo was disabled before this goal could leave", bus=self._parts.name, servo=servo)

    # Stops

    async def stop(self) -> dict[str, StopReport]:
        """E-stop this bus: drop everything that moves, stop every servo as its `on_estop` says (park: holds first)."""
        self.latched = True
        return await self._stop(lambda record: record.options.on_estop, list(self._parts.records.values()), JobKind.ESTOP)

    async def limp(self, servos: Sequence[str]) -> dict[str, StopReport]:
        """Switch torque off for these servos, ahead of everything that waits."""
        records = [self._parts.records[servo] for servo in servos]
        kind = JobKind.ESTOP if self.latched or self.leaving else JobKind.MOTION
        return await self._stop(lambda _: "limp", records, kind)

    async def abandon(self, servos: Collection[str]) -> dict[str, StopReport]:
        """Stop the enabled servos of a client that is gone as their `on_lost_client` says (park: hold first).

        The stop comes between two plans of other clients.
        """
        gone = LeaseHeld("the client that moved the servo is gone: nothing was sent")
        self._parts.scheduler.drop_goals(lambda servo: gone.at(bus=self._parts.name, servo=servo), servos)
        records = [self._parts.records[servo] for servo in servos if self._parts.records[servo].enabled]
        return await self._stop(lambda record: record.options.on_lost_client, records, JobKind.MOTION)

    async def leave(self) -> dict[str, StopReport]:
        """Stop each servo whose torque may be on because of us as its `on_exit` says; park is the rig's."""
        return await self._stop(lambda record: record.options.on_exit, self.to_leave(), JobKind.ESTOP)

    def to_leave(self) -> list[ServoRecord]:
        """Return the servos whose torque may be on because of us."""
        return [record for record in self._parts.records.values() if record.touched]

    async def _stop(
        self, action_of: Callable[[ServoRecord], str], servos: Sequence[ServoRecord], kind: JobKind
    ) -> dict[str, StopReport]:
        if not servos:
            return {}
        records = sorted(servos, key=lambda record: record.node.health is not ONLINE)
        targets = [self._stop_target(record, action_of(record)) for record in records]
        limp = [record for record, target in zip(records, targets, strict=True) if target.kind == "limp"]
        plan = self._parts.driver.stop(targets)
        future: asyncio.Future[dict[str, StopReport]] = self._loop.create_future()
        job = Job(future, math.inf, plan=plan, node=records[0].node.id, kind=kind, tries=1)
        for record in records:
            record.hold_at(None)
        for record in limp:
            _disable(record)
        try:
            self._parts.master.submit_stop(job)
            reports = await future
        except ServobusError as error:
            if not future.done():
                job.fail(error)
                future.exception()
            reports = {target.servo: StopReport(target.kind, False, False, str(error)) for target in targets}
        for record in limp:
            record.touched = record.touched and not reports[record.name].confirmed
        return {record.name: reports[record.name] for record in servos}

    def _stop_target(self, record: ServoRecord, action: str) -> StopTarget:
        return StopTarget(
            record.name,
            "limp" if action == "limp" else "hold",
            enabled=record.enabled,
            position=record.position(self._parts.clock(), FRESH),
            setpoint=record.setpoint,
            reachable=record.node.health is not OFFLINE,
        )

    async def park(self, servo: str) -> StopReport:
        """Go to the park pose within `park_timeout`, then go limp, even if the pose was not reached. Allowed while latched."""
        record = self._parts.records[servo]
        options = record.options
        detail = ""
        try:
            # A servo that has restarted is limp, and must not be moved: the fence finds out.
            fence = self._parts.scheduler.fence(record.node)
            await self._requests.perform(fence, record.node.id, servo=servo, even_if_offline=True)
            if not record.enabled:
                return StopReport("none", False, True, "the servo was disabled, or has restarted")
            assert options.park_pose is not None
            goal = ServoGoal(servo, Goal("position", options.park_pose), record.start(self._parts.clock(), FRESH))
            await self.put({servo: goal}, together=False, confirm=False)[servo]
            await self.settle(servo, tolerance=None, timeout=options.park_timeout, parking=True)
        except ServobusError as error:
            detail = f"not at its park pose: {error.message}"
        report = (await self.limp([servo]))[servo]
        record.touched = False  # the report tells; a hold at exit would only stiffen what should be limp
        return replace(report, action="park", confirmed=report.confirmed and not detail, detail=detail or report.detail)

    # Arrival

    async def settle(self, servo: str, *, tolerance: float | None, timeout: float, parking: bool = False) -> State:
        """Wait until the servo rests at its goal. `tolerance` in its unit, `timeout` in seconds.

        Raises SettleTimeout with its position, EStopped and NotEnabled when it cannot arrive any more.
        """
        parts, record = self._parts, self._parts.records[servo]
        moving = record.enabled
        near = TOLERANCE_STEPS * parts.driver.step(servo) if tolerance is None else tolerance
        end = parts.clock() + timeout
        while True:
            self._refuse_to_settle(record, moving, parking)
            state = await self._read(servo, SETTLE_PERIOD)
            if state.moving:  # polls of the position alone do not refresh this
                state = await self._read(servo, None)
            self._refuse_to_settle(record, moving, parking)  # a stop or a restart meanwhile has changed its goal
            there = record.goal is None or (state.position is not None and abs(state.position - record.goal) <= near)
            if there and not state.moving and servo not in parts.scheduler.ramps.active:
                return state
            if parts.clock() >= end:
                raise SettleTimeout(
                    f"the servo did not settle within {timeout:g} s: it is at {state.position}, its goal is {record.goal}",
                    bus=parts.name,
                    servo=servo,
                )
            await asyncio.sleep(SETTLE_PERIOD)

    def _refuse_to_settle(self, record: ServoRecord, moving: bool, parking: bool) -> None:
        if self.latched and not parking:
            raise EStopped("the e-stop came before the servo arrived at its goal", bus=self._parts.name, servo=record.name)
        if moving and not record.enabled:
            message = "the servo was disabled, or has restarted, before it arrived at its goal"
            raise NotEnabled(message, bus=self._parts.name, servo=record.name)


OUTCOME_COUNTERS = {
    Outcome.ACKED: Counter.GOALS_ACKED,
    Outcome.SENT: Counter.GOALS_SENT,
    Outcome.SUPERSEDED: Counter.GOALS_SUPERSEDED,
}


def _disable(record: ServoRecord) -> None:
    record.generation += 1
    record.enabled = False
