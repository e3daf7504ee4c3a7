"""Meeting the servos of a bus: when its line comes up, and when one appears later. Writes nothing."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from servobus.bus.records import ServoRecord
from servobus.engine.health import Condition, Node
from servobus.engine.line import EchoFilter
from servobus.engine.queue import Callback, Job
from servobus.errors import LinkDown, ReplyTimeout, ServobusError
from servobus.values import Identity

if TYPE_CHECKING:
    from servobus.bus.service import BusService

PATIENCE = 2.0
"""Seconds that the question may wait for its turn."""
PAUSE = 1.0
"""Seconds between two attempts to learn who a servo is that answers, but not to that."""


class Discovery:
    """Who is there, once for each node: what one servo says of it holds for the others."""

    def __init__(self, bus: BusService) -> None:
        self._bus = bus

    async def identify_all(self) -> None:
        """A missing servo is an event, no error."""
        nodes = dict.fromkeys(record.node for record in self._bus.records.values())
        await asyncio.gather(*map(self._meet, nodes))

    async def probe_echo(self) -> None:
        """A question nobody answers: what is heard is our own voice."""
        bus = self._bus
        before = bus.stats.counts["echoes"]
        try:
            await bus.ask(bus.driver.unused(), tries=1)
        except ReplyTimeout:
            pass
        except LinkDown:
            return
        if bus.stats.counts["echoes"] > before:
            bus.line.echo = EchoFilter()
        bus.event("echo_probed", bus=bus.name, echo="on" if bus.line.echo else "off")

    async def _meet(self, node: Node) -> None:
        bus = self._bus
        records = bus.on(node)
        try:
            await bus.identify(records[0].name)
            for record in records:
                await bus.read(record.name)
        except ServobusError as error:
            names = ",".join(record.name for record in records)
            bus.event("servo_missing", bus=bus.name, servo=names, id=node.id, reason=error.message)

    def identified(self, record: ServoRecord, identity: Identity) -> None:
        """Somebody was asked who it is."""
        if record.identity != identity:
            for note in identity.notes:
                self._bus.event("servo_note", bus=self._bus.name, servo=record.name, note=note)
        for other in self._bus.on(record.node):
            other.identity = identity

    def changed(self, node: Node, now: float) -> None:
        """One that was missing at the start has appeared."""
        record = self._bus.on(node)[0]
        if node.condition is not Condition.ONLINE or record.identity is not None or now < record.identify_after:
            return
        record.identify_after = now + PAUSE

        def introduced(result: Identity | Exception) -> None:
            if isinstance(result, Identity):
                self.identified(record, result)

        plan = self._bus.driver.identify(record.name)
        self._bus.scheduler.requests.put(Job(Callback(introduced), now + PATIENCE, plan=plan, node=node.id))
