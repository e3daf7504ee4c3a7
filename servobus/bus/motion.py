"""Everything that moves on one bus: goals, enable, disable, parking, arrival. `stops.py` ends it.

Refusals come first and cost no byte. What an e-stop or a restart has ended is never sent again.
"""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

from servobus.bus.limits import check_goal
from servobus.bus.records import ServoRecord
from servobus.bus.requests import BusParts, Requests
from servobus.bus.stops import Stops
from servobus.engine.coalescer import Ticket
from servobus.engine.job import JobKind
from servobus.engine.stats import Counter
from servobus.errors import Busy, DeviceError, EStopped, LinkDown, NotEnabled, ServobusError, SettleTimeout
from servobus.values import EventName, Goal, Identity, Loss, Outcome, ServoGoal, State, StopReport

MIN_START_WITHIN = 0.2
"""Seconds a goal may wait for its first byte, unless two learned turns take longer."""
FRESH = 0.1
"""Seconds for which a position is good enough to be where a motion starts."""
SESSION = "a scan or commissioning session has this bus: wait until it ends"
SETTLE_PERIOD = 0.02
OTHERS_PATIENCE = 20.0
"""Seconds for which an enable or a disable waits for those of the other servos: each takes some turns, and a pause."""
_batches = itertools.count(1)
# Looking a member up in its enum is a Python call, and these are needed for every goal.
GOALS, SUPERSEDED = Counter.GOALS, Outcome.SUPERSEDED


class Motion:
    """Goals of one bus."""

    def __init__(
        self,
        parts: BusParts,
        requests: Requests,
        stops: Stops,
        *,
        identify: Callable[[str], Awaitable[Identity]],
        read: Callable[[str, float | None], Awaitable[State]],
    ) -> None:
        self._parts = parts
        self._requests = requests
        self._stops = stops
        self._identify = identify
        self._read = read
        self._loop = asyncio.get_running_loop()
        self.enabling: set[str] = set()
        """Servos whose enable is under way."""

    def refuse(self) -> None:
        """Raise what refuses all motion on this bus now: EStopped, Busy, NotEnabled."""
        if self._stops.latched:
            raise EStopped("the e-stop is latched: `clear` releases it", bus=self._parts.name)
        if self._parts.scheduler.session is not None:
            raise Busy(SESSION, bus=self._parts.name)
        if self._stops.leaving:
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
        expires = now + self.start_within(goal.servo, goal.goal)
        done = partial(self._ended, record, goal.goal, future)
        ticket = Ticket(goal, record.node.id, expires, done, batch, confirm, future.cancelled, now)
        parts.stats.counts[GOALS] += 1
        speed = parts.driver.host_speed(goal)
        start = record.setpoint if record.ramped else goal.start
        record.ramped = speed is not None
        parts.scheduler.put_goal(ticket, now, speed=speed, start=start)
        return future

    def start_within(self, servo: str, goal: Goal) -> float:
        """Return the seconds within which the first byte of a goal must leave."""
        record = self._parts.records[servo]
        within = goal.start_within or record.options.ttl
        if within:
            return within
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
                record.cut = None
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
        """Set the goal to the present position, then switch torque on. Raises EStopped, Busy, NotEnabled, DeviceError.

        A servo that is enabled and on its way is held first: where its driver refuses a servo that moves, it would travel on.
        """
        self.refuse()
        record = self._parts.records[servo]
        if record.enabled and not record.arrived(self._stops.near(servo)):
            await self._stops.hold([servo])
            self.refuse()
        generation = record.generation
        self.enabling.add(servo)
        try:
            if record.identity is None:
                await self._identify(servo)
                self.refuse()
            record.enabled = False
            record.touched = True  # also when this is cancelled or fails half-way
            plan = self._parts.driver.enable(servo)
            present = await self._requests.perform(
                plan, record.node.id, servo=servo, kind=JobKind.MOTION, patience=OTHERS_PATIENCE
            )
        finally:
            self.enabling.discard(servo)
        if self._stops.latched or self._stops.leaving:
            raise EStopped("the e-stop came while the servo was being enabled", bus=self._parts.name, servo=servo)
        if record.generation != generation:
            raise NotEnabled("the servo was disabled while it was being enabled", bus=self._parts.name, servo=servo)
        record.hold_at(present)
        record.torque_is(on=True)
        self._stops.forgive(servo)
        goals = self._parts.scheduler.goals
        goals.ramps.drop({servo})
        goals.verification.confirm(servo, self._parts.clock())
        record.enabled = True

    async def disable(self, servo: str) -> None:
        """Switch torque off and read it back. Raises Busy in an exclusive session, DeviceError where it is not confirmed."""
        record = self._parts.records[servo]
        if self._parts.scheduler.session is not None:
            raise Busy(SESSION, bus=self._parts.name, servo=servo)
        self._parts.scheduler.drop_goals(self._disabled, {servo})
        record.disable()
        if not record.arrived(self._stops.near(servo)):
            record.cut = NotEnabled("the servo was disabled before it arrived at its goal")
        plan = self._parts.driver.disable(servo)
        report = await self._requests.perform(plan, record.node.id, servo=servo, even_if_offline=True, patience=OTHERS_PATIENCE)
        if not report.confirmed:
            message = f"it is not confirmed that it is disabled: {report.detail}"
            raise DeviceError(message, bus=self._parts.name, servo=servo)
        record.disable()
        record.torque_is(on=False)
        record.touched = False
        self._stops.forgive(servo)

    def lost(self, records: Sequence[ServoRecord], loss: Loss) -> list[ServoRecord]:
        """Disable servos that are not as they were left; return those that were enabled."""
        lost = [record for record in records if record.enabled]
        for record in lost:
            record.hold_at(None, NotEnabled(f"before the servo arrived at its goal: {loss.description}"))
            record.enabled = False
        self._parts.scheduler.drop_goals(partial(self._lost, loss), {record.name for record in records})
        return lost

    def _lost(self, loss: Loss, servo: str) -> ServobusError:
        message = f"{loss.description} It is disabled, and nothing was sent: enable it again"
        return NotEnabled(message, bus=self._parts.name, servo=servo)

    def _disabled(self, servo: str) -> ServobusError:
        return NotEnabled("the servo was disabled before this goal could leave", bus=self._parts.name, servo=servo)

    # Parking

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
        report = (await self._stops.limp([servo]))[servo]
        record.touched = False  # the report tells; a hold at exit would only stiffen what should be limp
        return replace(report, action="park", confirmed=report.confirmed and not detail, detail=detail or report.detail)

    # Arrival

    async def settle(self, servo: str, *, tolerance: float | None, timeout: float, parking: bool = False) -> State:
        """Wait until the servo rests at its goal. `tolerance` in its unit, `timeout` in seconds.

        Raises SettleTimeout with its position, EStopped and NotEnabled when it cannot arrive any more.
        """
        parts, record = self._parts, self._parts.records[servo]
        moving = record.enabled
        near = self._stops.near(servo) if tolerance is None else tolerance
        end = parts.clock() + timeout
        before: State | None = None
        step = parts.driver.step(servo)
        while True:
            self._refuse_to_settle(record, moving, parking)
            state = await self._read(servo, SETTLE_PERIOD)
            if state.moving:  # polls of the position alone do not refresh this
                state = await self._read(servo, None)
            self._refuse_to_settle(record, moving, parking)  # a stop or a restart meanwhile has changed its goal
            there = record.goal is None or (state.position is not None and abs(state.position - record.goal) <= near)
            if there and servo not in parts.scheduler.goals.ramps.active and (record.goal is None or _rests(state, before, step)):
                return state
            before = state
            if parts.clock() >= end:
                raise SettleTimeout(
                    f"the servo did not settle within {timeout:g} s: it is at {state.position}, its goal is {record.goal}",
                    bus=parts.name,
                    servo=servo,
                )
            await asyncio.sleep(SETTLE_PERIOD)

    def _refuse_to_settle(self, record: ServoRecord, moving: bool, parking: bool) -> None:
        if self._stops.latched and not parking:
            raise EStopped("the e-stop came before the servo arrived at its goal", bus=self._parts.name, servo=record.name)
        if moving and not record.enabled:
            message = "the servo was disabled, or has restarted, before it arrived at its goal"
            raise NotEnabled(message, bus=self._parts.name, servo=record.name)
        if record.cut is not None:
            raise record.cut.at(bus=self._parts.name, servo=record.name)


def _rests(state: State, before: State | None, step: float) -> bool:
    """Return whether a servo rests: it says so, or two readings agree that are half a period apart or more."""
    if state.moving is not None:
        return not state.moving
    if before is None or state.position is None or before.position is None or state.time is None or before.time is None:
        return False
    return abs(state.position - before.position) <= step and state.time - before.time >= SETTLE_PERIOD / 2


OUTCOME_COUNTERS = {
    Outcome.ACKED: Counter.GOALS_ACKED,
    Outcome.SENT: Counter.GOALS_SENT,
    Outcome.SUPERSEDED: Counter.GOALS_SUPERSEDED,
}
