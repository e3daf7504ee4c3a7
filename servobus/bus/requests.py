"""How the parts of a bus ask its servos something, and what those parts share."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import Any, TypeVar

from servobus.bus.master import BusMaster
from servobus.bus.records import ServoRecord
from servobus.engine.health import Node, NodeTable
from servobus.engine.job import TRIES, Job, JobKind
from servobus.engine.line import Line
from servobus.engine.scheduler import Scheduler
from servobus.engine.stats import BusStats
from servobus.errors import DeviceError, ServobusError
from servobus.protocols.base import Driver, Plan, Request

R = TypeVar("R")

ORDINARY = JobKind.ORDINARY
PATIENCE = 2.0
"""Seconds for which a request may wait for its turn."""
DOWN_PAUSE = 0.02
"""Seconds before a refusal reaches its caller: one that asks again and again while the line is down does not burn the core."""

EmitEvent = Callable[..., None]
"""`emit(name, **fields)` reports what a person or a log should know."""


@dataclass(frozen=True, slots=True)
class BusParts:
    """What service, motion, discovery and commissioning of one bus share."""

    name: str
    driver: Driver
    records: dict[str, ServoRecord]
    nodes: NodeTable
    scheduler: Scheduler
    line: Line
    stats: BusStats
    master: BusMaster
    clock: Callable[[], float]
    emit: EmitEvent

    def on(self, node: Node) -> list[ServoRecord]:
        """Return the servos of a node."""
        return [record for record in self.records.values() if record.node is node]


class Requests:
    """Requests and plans of one bus; their errors name bus and servo."""

    def __init__(self, parts: BusParts) -> None:
        self._parts = parts
        self._loop = asyncio.get_running_loop()

    def ask(
        self,
        request: Request[R],
        *,
        servo: str | None = None,
        even_if_offline: bool = False,
        session: object = None,
        tries: int = TRIES,
    ) -> Coroutine[Any, Any, R]:
        """Send one request and return its value. `servo` is the one that errors name.

        Raises ReplyTimeout, DeviceError, LinkDown, Overloaded.
        """
        future: asyncio.Future[R] = self._loop.create_future()
        expires = self._parts.clock() + PATIENCE
        job = Job(future, expires, request, None, 0, ORDINARY, even_if_offline, session, tries)
        return self._result(job, future, servo)

    def read_register(self, servo: str, register: str, *, raw: bool = False) -> Coroutine[Any, Any, Any]:
        """Read one register: its physical value, or its integer with `raw`. Raises as `ask`, UnknownName, NotSupported."""
        return self.ask(self._parts.driver.read_register(servo, register, raw=raw), servo=servo)

    def perform(
        self,
        plan: Plan[R],
        node: int,
        *,
        servo: str | None = None,
        kind: JobKind = ORDINARY,
        even_if_offline: bool = False,
        session: object = None,
        patience: float = PATIENCE,
    ) -> Coroutine[Any, Any, R]:
        """Run a plan and return its result; only an e-stop comes between its frames. Raises as `ask`.

        `patience`: seconds for which it may wait for its turn.
        """
        future: asyncio.Future[R] = self._loop.create_future()
        expires = self._parts.clock() + patience
        job = Job(future, expires, None, plan, node, kind, even_if_offline, session)
        return self._result(job, future, servo)

    async def _result(self, job: Job, future: asyncio.Future[R], servo: str | None) -> R:
        try:
            self._parts.master.submit(job)
        except ServobusError as error:
            job.fail(error)
            await asyncio.sleep(DOWN_PAUSE)
        try:
            return await future
        except ServobusError as error:
            failure = error.at(bus=self._parts.name, servo=servo)
        if isinstance(failure, DeviceError) and job.plan is None and servo is not None:
            failure = await self._explained(failure, servo)
        raise failure

    async def _explained(self, error: DeviceError, servo: str) -> ServobusError:
        """Return the error with the servo's own reason for its refusal, where it can be asked for one."""
        driver = self._parts.driver
        plan = driver.explain(servo, error)
        if plan is None:
            return error
        try:
            return (await self.perform(plan, driver.nodes[servo], servo=servo)).at(bus=self._parts.name, servo=servo)
        except ServobusError:
            return error
