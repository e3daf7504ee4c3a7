"""Stops of one bus: e-stop, limp, a lost client, the exit; and the stops that servos owe.

How `_stop` works, for all of them alike:

1. Records of servos that go limp are disabled before anything is sent, so that no goal can follow the torque off.
2. Nodes that are online are asked before the others: a dead servo must not hold up a live one.
3. The driver reads a servo that answers and holds it where it was just read. Where it does not answer, it is held where it is
   taken to be, if that was read a moment ago.
4. The report says for each servo what was written, and what was confirmed by reading its effect back. An error of the whole stop
   (the line is down) becomes a report for each servo.

A servo whose stop is not confirmed owes one:

5. It is stopped again, before anything else, as soon as its node answers.
6. While its node does not answer, it is probed more often than others, and each probe begins with the frames that stop it
   without a question (`Motion.blind_stop`): torque off, speed 0.
7. While its node answers and the stop is not confirmed (a lossy line), it is stopped again every `PAUSE`.
8. The debt ends when the stop is confirmed, and when somebody enables or disables the servo.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import Any

from servobus.bus.records import ServoRecord
from servobus.bus.requests import BusParts
from servobus.engine.health import OFFLINE, ONLINE, Node
from servobus.engine.job import Callback, Job, JobKind
from servobus.errors import EStopped, LeaseHeld, NotEnabled, ServobusError
from servobus.protocols.base import Request
from servobus.values import EventName, StopReport, StopTarget

ESTIMATE_AGE = 0.1
"""Seconds after its last reading for which a servo is held blindly: one that restarted meanwhile does not take a frame yet."""
PAUSE = 0.05
"""Seconds between two stops of a servo that answers and does not confirm."""
TOLERANCE_STEPS = 10
"""Steps from its goal within which a servo has arrived."""

ActionOf = Callable[[ServoRecord], str]


class Stops:
    """What stops servos on one bus, and whether all of them have confirmed it."""

    def __init__(self, parts: BusParts) -> None:
        self._parts = parts
        self._loop = asyncio.get_running_loop()
        self.latched = False
        """The e-stop holds: motion and enable are refused until it is cleared."""
        self.leaving = False
        """The rig is being left: nothing new begins."""
        self.owed: dict[str, str] = {}
        """Servo -> the stop that it has not confirmed: hold or limp."""
        self._paying: set[str] = set()
        self._timer: asyncio.TimerHandle | None = None
        self._paid = asyncio.Event()
        self._reports: dict[str, StopReport] = {}
        """What servos confirmed after the first try."""

    @property
    def _kind(self) -> JobKind:
        return JobKind.ESTOP if self.latched or self.leaving else JobKind.MOTION

    def near(self, servo: str) -> float:
        """Return how far from its goal, in its unit, a servo counts as arrived."""
        return TOLERANCE_STEPS * self._parts.driver.step(servo)

    async def stop(self) -> dict[str, StopReport]:
        """E-stop this bus: drop everything that moves, stop every servo as its `on_estop` says (park: holds first)."""
        self.latched = True
        cut = EStopped("the e-stop came before the servo arrived at its goal")
        return await self._stop(lambda record: record.options.on_estop, list(self._parts.records.values()), cut)

    async def hold(self, servos: Sequence[str]) -> dict[str, StopReport]:
        """Hold these servos, ahead of everything that waits."""
        records = [self._parts.records[servo] for servo in servos]
        return await self._stop(lambda _: "hold", records, NotEnabled("the servo was enabled anew before it arrived at its goal"))

    async def limp(self, servos: Sequence[str]) -> dict[str, StopReport]:
        """Switch torque off for these servos, ahead of everything that waits."""
        records = [self._parts.records[servo] for servo in servos]
        return await self._stop(lambda _: "limp", records, NotEnabled("the servo went limp before it arrived at its goal"))

    async def abandon(self, servos: Collection[str]) -> dict[str, StopReport]:
        """Stop the enabled servos of a client that is gone as their `on_lost_client` says (park: hold first).

        The stop comes between two plans of other clients.
        """
        gone = LeaseHeld("the client that moved the servo is gone: nothing was sent")
        self._parts.scheduler.drop_goals(lambda servo: gone.at(bus=self._parts.name, servo=servo), servos)
        records = [self._parts.records[servo] for servo in servos if self._parts.records[servo].enabled]
        cut = LeaseHeld("the client that moved the servo is gone: it was stopped before it arrived at its goal")
        return await self._stop(lambda record: record.options.on_lost_client, records, cut)

    async def leave(self, left: dict[str, StopReport]) -> None:
        """Stop each servo whose torque may be on because of us as its `on_exit` says (park: hold first), until all have
        confirmed it. `left` takes the report of each, as it comes."""
        left |= await self._stop(lambda record: record.options.on_exit, self.to_leave(), None)
        while any(servo in self.owed for servo in left):
            self._paid.clear()
            await self._paid.wait()
            left |= {servo: report for servo, report in self._reports.items() if servo in left}

    def to_leave(self) -> list[ServoRecord]:
        """Return the servos whose torque may be on because of us."""
        return [record for record in self._parts.records.values() if record.touched]

    async def _stop(self, action_of: ActionOf, servos: Sequence[ServoRecord], cut: ServobusError | None) -> dict[str, StopReport]:
        if not servos:
            return {}
        records = sorted(servos, key=lambda record: record.node.health is not ONLINE)
        targets = [self._target(record, action_of(record)) for record in records]
        plan = self._parts.driver.stop(targets)
        future: asyncio.Future[dict[str, StopReport]] = self._loop.create_future()
        job = Job(future, math.inf, plan=plan, node=records[0].node.id, kind=self._kind, tries=1)
        for record, target in zip(records, targets, strict=True):
            record.hold_at(None, record.cut if record.arrived(self.near(record.name)) else cut)
            if target.kind == "limp":
                record.disable()
        try:
            self._parts.master.submit_stop(job)
            reports = await future
        except ServobusError as error:
            if not future.done():
                job.fail(error)
                future.exception()
            reports = {target.servo: StopReport(target.kind, False, False, str(error)) for target in targets}
        for target in targets:
            self._note(target, reports[target.servo])
        self._repeat_later()
        return {record.name: reports[record.name] for record in servos}

    def _target(self, record: ServoRecord, action: str) -> StopTarget:
        """Return the target of a stop. A servo that owes to go limp is not held instead."""
        return StopTarget(
            record.name,
            "limp" if "limp" in (action, self.owed.get(record.name)) else "hold",
            enabled=record.enabled,
            position=record.estimate(self._parts.clock(), ESTIMATE_AGE),
            setpoint=record.setpoint,
            reachable=record.node.health is not OFFLINE,
            energised=record.energised,
            leave_alone=self.leaving and not (self.latched or record.enabled),
        )

    # Stops that are owed

    def _note(self, target: StopTarget, report: StopReport) -> None:
        """Note what became of a stop."""
        record, emit = self._parts.records[target.servo], self._parts.emit
        if target.kind == "limp":
            record.touched = record.touched and not report.confirmed
        if not report.confirmed:
            if target.servo not in self.owed:
                emit(EventName.STOP_OWED, bus=self._parts.name, servo=target.servo, action=target.kind, detail=report.detail)
            self.owed[target.servo] = target.kind
            self._mark(record.node)
        elif target.servo in self.owed:
            self._reports[target.servo] = report
            self.forgive(target.servo)
            emit(EventName.STOP_PAID, bus=self._parts.name, servo=target.servo, action=report.action)

    def forgive(self, servo: str) -> None:
        """End the debt of a servo."""
        if self.owed.pop(servo, None) is not None:
            self._mark(self._parts.records[servo].node)
            self._paid.set()

    def _mark(self, node: Node) -> None:
        owed = any(record.name in self.owed for record in self._parts.on(node))
        node.owe_stop(self._parts.clock(), owed=owed)

    def blind_frames(self, node: Node) -> list[Request[Any]]:
        """Return what stops the servos of a node that owe it, without a question."""
        driver = self._parts.driver
        targets = [self._target(record, self.owed[record.name]) for record in self._parts.on(node) if record.name in self.owed]
        return [frame for target in targets for frame in driver.blind_stop(target)]

    def node_online(self, node: Node) -> None:
        """Stop the servos of this node that owe it: it answers again."""
        if node.owes_stop:
            self._pay([record for record in self._parts.on(node) if record.name in self.owed])

    def _pay(self, records: Sequence[ServoRecord]) -> None:
        records = [record for record in records if record.name not in self._paying]
        if not records or not self._parts.master.up:
            return
        targets = [self._target(record, self.owed[record.name]) for record in records]
        self._paying.update(target.servo for target in targets)
        sink = Callback(partial(self._stopped_again, targets))
        plan = self._parts.driver.stop(targets)
        self._parts.scheduler.put_stop(Job(sink, math.inf, plan=plan, node=records[0].node.id, kind=self._kind))
        self._parts.scheduler.wanted()

    def _stopped_again(self, targets: Sequence[StopTarget], result: dict[str, StopReport] | Exception) -> None:
        for target in targets:
            self._paying.discard(target.servo)
            if not isinstance(result, Exception) and target.servo in self.owed:
                self._note(target, result[target.servo])
        self._repeat_later()

    def _repeat_later(self) -> None:
        """Set the timer for the servos that answer and have not confirmed; the others are stopped when they answer."""
        if self._timer is None and any(self._parts.records[servo].node.health is ONLINE for servo in self.owed):
            self._timer = self._loop.call_later(PAUSE, self._repeat)

    def _repeat(self) -> None:
        self._timer = None
        records = [self._parts.records[servo] for servo in self.owed]
        self._pay([record for record in records if record.node.health is ONLINE])
        if not self._paying:
            self._repeat_later()

    def close(self) -> None:
        """End for good: the line is left."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
