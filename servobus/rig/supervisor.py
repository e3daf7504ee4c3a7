"""BusSupervisor: one bus of a rig and its line.

It opens the port, has the servos identified, waits until the line ends and opens it again; nothing of this touches another bus.
Nothing is written at start. At the end every servo that was enabled here is left as its `on_exit` says.
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

Trace = Callable[[str, bool, bytes, float], None]  # (bus, sent, bytes, monotonic seconds) of everything on the wire

RETRY = 0.1  # seconds between two attempts to open a port
EARLY = 1.0  # a line that ends sooner than this cannot be used: the next attempts have growing pauses
MAX_PAUSE = 3.2  # seconds, the longest of them
TELNET, TELNET_VERBS = 0xFF, range(0xFB, 0xFF)  # IAC, and WILL to DONT (RFC 854)
EXIT_TIMEOUT = 1.0  # seconds that the exit policies may take, besides parking


class BusSupervisor:
    """`event(name, **fields)` is called with each event of the bus (see `EventName`)."""

    def __init__(
        self, name: str, options: BusOptions, models: Mapping[str, ServoModel], event: Callable[..., None], trace: Trace | None
    ) -> None:
        protocol = PROTOCOLS[options.protocol]
        self.name = name
        self.options = options
        self.link: Link = (
            simulated_link(options, models)
            if options.port.startswith(SIMULATED)
            else open_link(options.port, options.baudrate, rs485=options.rs485)
        )
        driver = protocol.driver(options, models)
        self.bus = BusService(name, options, driver, protocol.codec(options), self.link.traits, event)
        if trace is not None:
            self.bus.master.trace = partial(trace, name)
        self.tried = asyncio.Event()  # set once the line was opened, or could not be
        self.down: LinkDown | None = None
        self.scope = anyio.CancelScope()
        self._pause = 0.0  # seconds before the next attempt, after a line that ended early
        self._event = event

    async def run(self, degraded: bool) -> None:
        """Open the line, and again whenever it ends, until `scope` is cancelled."""
        with self.scope:
            while True:
                await self._serve(degraded)

    async def _serve(self, degraded: bool) -> None:
        self.bus.line.use(self.link.traits)  # another port may have come back under this name
        try:
            await self.link.connect(self.bus.master)
        except LinkDown as error:
            tried = self.tried.is_set()  # the first failure may be raised, and is then no event too
            if (tried or degraded) and str(error) != str(self.down):
                self._event(EventName.WAITING_FOR_PORT, bus=self.name, port=self.link.address, reason=error.message)
            self.down = error
            self.tried.set()
            await anyio.sleep(RETRY)
            return
        opened_at = self.bus.clock()
        if self._pause:  # the last line ended early: nothing is said before this one has lived longer
            with anyio.move_on_after(EARLY):
                await self.bus.master.wait_closed()
                await self._ended_early()
                return
        self.down = None
        self.bus.line.use(self.link.traits)  # a tunnel knows its limits only now
        self._event(EventName.LINE_UP, bus=self.name, port=self.link.address)
        await self.bus.start()
        self.tried.set()
        await self.bus.master.wait_closed()
        self._event(EventName.LINE_DOWN, bus=self.name, port=self.link.address)
        if self.bus.clock() - opened_at < EARLY:
            await self._ended_early()
        else:
            self._pause = 0.0

    async def _ended_early(self) -> None:
        """Say once that the line ends as soon as it is opened, and wait before the next attempt, longer each time."""
        error = LinkDown(f"{self.link.address} opens and ends at once{_greeted(self.bus.line.greeting)}")
        if str(error) != str(self.down):
            self._event(EventName.WAITING_FOR_PORT, bus=self.name, port=self.link.address, reason=error.message)
        self.down = error
        self._pause = min(2 * self._pause, MAX_PAUSE) or RETRY
        await anyio.sleep(self._pause)

    def enabled(self, policy: str, kind: str) -> list[ServoRecord]:
        """The enabled servos whose `policy` (on_estop, on_exit, on_lost_client) is this kind."""
        return [record for record in self.bus.records.values() if record.enabled and getattr(record.options, policy) == kind]

    def in_use(self) -> list[str]:
        """Full names of the servos that are enabled, or are being enabled, or owe a stop."""
        bus = self.bus
        used = [name for name, record in bus.records.items() if record.enabled or name in {*bus.motion.enabling, *bus.stops.owed}]
        return [f"{self.name}/{name}" for name in used]

    async def park(self, record: ServoRecord) -> StopReport:
        """Move a servo to its park pose, then switch its torque off, also when it does not get there in time."""
        report = await self.bus.motion.park(record.name)
        if not report.confirmed:
            self._event(EventName.PARK_UNCONFIRMED, bus=self.name, servo=record.name, detail=report.detail)
        return report

    async def leave(self) -> dict[str, StopReport]:
        """Apply the exit policies. Returns what was done to each servo, by full name.

        What is to be limp goes limp, and everything else holds, before the first servo parks: nothing travels on meanwhile.
        """
        stops = self.bus.stops
        stops.leaving = True
        silent = "no answer in time"
        left = {record.name: StopReport(record.options.on_exit, False, False, silent) for record in stops.to_leave()}
        parking = [] if stops.latched else self.enabled("on_exit", "park")  # what the e-stop holds stays where it is
        with anyio.move_on_after(EXIT_TIMEOUT):
            await stops.leave(left)
        reports = await asyncio.gather(*map(self.park, parking))
        left.update({record.name: report for record, report in zip(parking, reports, strict=True)})
        for servo, report in left.items():
            if not report.confirmed and report.action != "park":  # parking has its own event
                self._event(EventName.EXIT_UNCONFIRMED, bus=self.name, servo=servo, action=report.action, detail=report.detail)
        return {f"{self.name}/{servo}": report for servo, report in left.items()}

    async def close(self) -> None:
        """Close the line, once nothing opens it again."""
        self.bus.stops.close()
        await self.bus.master.close()
        if isinstance(self.link, SimulatedLink):
            self.link.close()


def why_not_to_close(buses: Mapping[str, BusSupervisor], *, force: bool) -> str:
    """Why a reload must not close these buses now; empty: it may. Enabled servos and owed stops are no reason if it is forced."""
    if sessions := [name for name, each in buses.items() if each.bus.scheduler.session is not None]:
        return f"a scan or commissioning session has {', '.join(sessions)}, which the new config closes: wait until it ends"
    servos = [] if force else [name for each in buses.values() for name in each.in_use()]
    if not servos:
        return ""
    what = f"the new config closes or opens again {', '.join(buses)}"
    return f"{what}, while these servos are enabled or owe a stop: {', '.join(servos)}; disable them first, or force it"


def _greeted(greeting: bytes) -> str:
    """What the first bytes of the other end tell, and the next step."""
    if any(bytes((TELNET, verb)) in greeting for verb in TELNET_VERBS):
        return ": it negotiates telnet: set the server's port to raw TCP"
    if greeting:
        text = greeting.decode("ascii", "backslashreplace").strip()
        return f": its greeting is {text!r}: is this the port of a serial line, and is another program connected to it?"
    return ": is another program connected to it, or is it another kind of server?"
