"""BusSupervisor: one bus of a rig, with the line it stands on.

It opens the port, introduces the servos, waits for the line to go down and opens it again, and none of it touches another bus.
Nothing is written at start; at the end every servo that was enabled here is left as its `on_exit` says.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from functools import partial

import anyio

from servobus.bus.records import ServoRecord
from servobus.bus.service import BusService
from servobus.errors import LinkDown
from servobus.links import open_link
from servobus.links.base import Link
from servobus.protocols.model import ServoModel
from servobus.protocols.options import BusOptions
from servobus.protocols.registry import PROTOCOLS
from servobus.simulation.link import SIMULATED, SimulatedLink, simulated_link
from servobus.values import EventName, StopReport

Trace = Callable[[str, bool, bytes, float], None]
"""(bus, sent, bytes, monotonic seconds) of everything on the wire."""

RETRY = 0.1
"""Seconds between two looks for a port that is not there."""
EXIT_TIMEOUT = 1.0
"""Seconds the exit policies may take, parking apart."""


class BusSupervisor:
    """`event(name, **fields)` is told what a person or a log should know."""

    def __init__(
        self,
        name: str,
        options: BusOptions,
        models: Mapping[str, ServoModel],
        event: Callable[..., None],
        trace: Trace | None,
    ) -> None:
        entry = PROTOCOLS[options.protocol]
        self.name = name
        self.options = options
        self.link: Link = (
            simulated_link(options, models)
            if options.port.startswith(SIMULATED)
            else open_link(options.port, options.baudrate, rs485=options.rs485)
        )
        driver = entry.driver(options, models)
        self.bus = BusService(name, options, driver, entry.codec(options), self.link.traits, event)
        if trace is not None:
            self.bus.master.trace = partial(trace, name)
        self.tried = asyncio.Event()
        """The line was tried once, and is up or down."""
        self.down: LinkDown | None = None
        self.scope = anyio.CancelScope()
        self._event = event

    async def run(self, degraded: bool) -> None:
        """Open the line, and again whenever it is gone, until `scope` is cancelled."""
        with self.scope:
            while True:
                await self._serve(degraded)

    async def _serve(self, degraded: bool) -> None:
        self.bus.line.traits = self.link.traits  # what the port is may have changed while it was away
        try:
            await self.link.connect(self.bus.master)
        except LinkDown as error:
            tried = self.tried.is_set()  # the first time it may be raised, and need not be told twice
            if (tried or degraded) and str(error) != str(self.down):
                self._event(EventName.WAITING_FOR_PORT, bus=self.name, port=self.link.address, reason=error.message)
            self.down = error
            self.tried.set()
            await anyio.sleep(RETRY)
            return
        self.down = None
        self.bus.line.traits = self.link.traits  # what is known of it only now: a tunnel's limits
        self._event(EventName.LINE_UP, bus=self.name, port=self.link.address)
        await self.bus.start()
        self.tried.set()
        await self.bus.master.wait_closed()
        self._event(EventName.LINE_DOWN, bus=self.name, port=self.link.address)

    def enabled(self, policy: str, kind: str) -> list[ServoRecord]:
        """The enabled servos whose `policy` (on_estop, on_exit, on_lost_client) is this kind."""
        return [record for record in self.bus.records.values() if record.enabled and getattr(record.options, policy) == kind]

    async def park(self, record: ServoRecord) -> StopReport:
        """To the park pose, then limp; limp also when it does not get there in time."""
        report = await self.bus.motion.park(record.name)
        if not report.confirmed:
            self._event(EventName.PARK_UNCONFIRMED, bus=self.name, servo=record.name, detail=report.detail)
        return report

    async def leave(self) -> dict[str, StopReport]:
        """Exit policies: park first where a servo says so. What became of each servo, by full name."""
        motion = self.bus.motion
        motion.leaving = True
        left = {
            record.name: StopReport(record.options.on_exit, False, False, "no answer in time") for record in motion.to_leave()
        }
        parking = [] if motion.latched else self.enabled("on_exit", "park")  # what the e-stop holds stays
        reports = await asyncio.gather(*map(self.park, parking))
        left.update({record.name: report for record, report in zip(parking, reports, strict=True)})
        with anyio.move_on_after(EXIT_TIMEOUT):
            left.update(await motion.leave())
        for servo, report in left.items():
            if not report.confirmed and report.action != "park":  # that has its own event
                self._event(EventName.EXIT_UNCONFIRMED, bus=self.name, servo=servo, action=report.action, detail=report.detail)
        return {f"{self.name}/{servo}": report for servo, report in left.items()}

    async def close(self) -> None:
        """Once nobody opens the line again."""
        await self.bus.master.close()
        if isinstance(self.link, SimulatedLink):
            self.link.close()
