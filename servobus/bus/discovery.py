"""Identifies the servos of a bus: when its line comes up, when one appears later, and after a restart. Writes nothing."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any

from servobus.bus.records import ServoRecord
from servobus.bus.requests import PATIENCE, BusParts, Requests
from servobus.engine.health import OFFLINE, ONLINE, Node
from servobus.engine.job import Callback, Job
from servobus.engine.line import EchoFilter
from servobus.engine.stats import Counter
from servobus.errors import LinkDown, ReplyTimeout, ServobusError
from servobus.protocols.base import Plan
from servobus.values import EventName, Health, Identity, State

PAUSE = 1.0
"""Seconds between two attempts to identify a servo that answers other requests, but not that one."""


ENERGISED = (
    "its torque is on, and servobus did not switch it on: it holds or goes on to a goal of another program; `stop` holds it, "
    "`disable` makes it limp"
)


class Discovery:
    """Who is there, once for each node: what one servo tells of its node holds for the others of that node."""

    def __init__(self, parts: BusParts, requests: Requests, read: Callable[[str], Awaitable[State]]) -> None:
        self._parts = parts
        self._requests = requests
        self._read = read

    async def probe_echo(self) -> None:
        """Find out whether the line echoes: send a request that no servo answers, so what comes back is our own."""
        parts = self._parts
        before = parts.stats.counts[Counter.ECHOES]
        try:
            await self._requests.ask(parts.driver.unused(), tries=1)
        except ReplyTimeout:
            pass
        except LinkDown:
            return
        if parts.stats.counts[Counter.ECHOES] > before:
            parts.line.echo = EchoFilter()
        parts.emit(EventName.ECHO_PROBED, bus=parts.name, echo="on" if parts.line.echo else "off")

    async def identify_all(self) -> None:
        """Identify every node and read every servo. A missing servo is an event, not an error."""
        nodes = dict.fromkeys(record.node for record in self._parts.records.values())
        await asyncio.gather(*map(self._identify_node, nodes))

    async def _identify_node(self, node: Node) -> None:
        records = self._parts.on(node)
        self.restarted(node)
        try:
            await self.identify(records[0].name)
            for record in records:
                await self._read(record.name)
        except ServobusError as error:
            names = ",".join(record.name for record in records)
            self._parts.emit(EventName.SERVO_MISSING, bus=self._parts.name, servo=names, id=node.id, reason=error.message)

    async def identify(self, servo: str) -> Identity:
        """Ask a servo who it is, even if it is offline."""
        record = self._parts.records[servo]
        plan = self._parts.driver.identify(servo)
        identity = await self._requests.perform(plan, record.node.id, servo=servo, even_if_offline=True)
        self._identified(record, identity)
        return identity

    def _identified(self, record: ServoRecord, result: Identity | Exception) -> None:
        if isinstance(result, Exception):
            return
        if record.identity != result:
            energised = (ENERGISED,) if result.energised and not record.touched else ()
            for note in (*result.notes, *energised):
                self._parts.emit(EventName.SERVO_NOTE, bus=self._parts.name, servo=record.name, note=note)
        for other in self._parts.on(record.node):
            other.identity = result

    def node_changed(self, node: Node, before: Health) -> None:
        """Identify a node that has come online for the first time. One that was offline may have restarted meanwhile."""
        if OFFLINE in (node.health, before):
            self.restarted(node)
        if node.health is not ONLINE:
            return
        now, record = self._parts.clock(), self._parts.on(node)[0]
        if record.identity is None and now >= record.identify_after:
            record.identify_after = now + PAUSE
            self._queue(node, self._parts.driver.identify(record.name), partial(self._identified, record))

    def restarted(self, node: Node) -> None:
        """Find out what became of a changed id or baud rate that waited for the restart of this node."""
        commissioning = self._parts.driver.commissioning
        plan = None if commissioning is None else commissioning.restarted(node.id)
        if plan is not None:
            self._queue(node, plan, _ignore)

    def _queue(self, node: Node, plan: Plan[Any], done: Callable[[Any], None]) -> None:
        """Queue a plan of ours. It is never refused: this is called in the middle of the node's fence, by no caller's request."""
        expires = self._parts.clock() + PATIENCE
        self._parts.scheduler.queue_own(Job(Callback(done), expires, plan=plan, node=node.id, even_if_offline=True))


def _ignore(_: object) -> None:
    pass
