"""From the options of a bus to its simulated line, and to a link that ends there.

`port: "sim:"` is a line whose bytes take their time, `port: "sim:?wire_time=off"` one whose bytes take none.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping

from servobus.errors import ConfigError
from servobus.links.base import FarEnd
from servobus.links.faulty import FaultyEnd
from servobus.links.memory import MemoryLink, MemoryTransport
from servobus.protocols.base import LineTraits
from servobus.protocols.model import ServoModel
from servobus.protocols.options import BusOptions
from servobus.protocols.registry import PROTOCOLS
from servobus.simulation.line import SimulatedLine

SIMULATED = "sim:"
PORTS = {"sim:": True, "sim:?wire_time=off": False}
"""What a simulated port may be called, and whether bytes take time there."""


def has_wire_time(port: str) -> bool:
    """Raises ConfigError for what is no simulated port."""
    try:
        return PORTS[port]
    except KeyError:
        known = " or ".join(f'"{form}"' for form in PORTS)
        raise ConfigError(f"port {port!r} is no simulated line: write {known}") from None


def simulated_line(
    options: BusOptions, models: Mapping[str, ServoModel], loop: asyncio.AbstractEventLoop, *, wire_time: bool = True
) -> SimulatedLine:
    """The servos of a bus, each standing at its zero."""
    entry = PROTOCOLS[options.protocol]
    devices = entry.devices(options, models)
    return SimulatedLine(
        devices,
        entry.device_codec(options),
        loop,
        baudrate=options.baudrate,
        wire_time=wire_time,
        four_wires=options.spread is not None,
    )


def far_end(options: BusOptions, line: SimulatedLine, loop: asyncio.AbstractEventLoop) -> FarEnd:
    """The line as its master meets it: behind the fault injector where the options want one."""
    if options.faults is None:
        return line
    entry = PROTOCOLS[options.protocol]
    return FaultyEnd(line, options.faults, loop, rename=entry.rename, node_of=entry.node_of)


class SimulatedLink(MemoryLink):
    """A link to a simulated line. The line, and with it what its servos know, outlives every connection."""

    def __init__(self, far: FarEnd, traits: LineTraits, address: str, line: SimulatedLine) -> None:
        super().__init__(far, traits, address)
        self.line = line
        self._baudrate = line.baudrate

    async def connect(self, protocol: asyncio.Protocol) -> MemoryTransport:
        """Like a port, it is opened at the rate of the config, whatever rate was tried before."""
        transport = await super().connect(protocol)
        self.line.set_baudrate(self._baudrate)
        return transport

    def close(self) -> None:
        """For good: nothing is said on this line any more."""
        self.line.close()


def simulated_link(options: BusOptions, models: Mapping[str, ServoModel], *, wire_time: bool = True) -> SimulatedLink:
    """To be called where a loop runs. `wire_time=False`: bytes take no time, whatever the port says. Raises ConfigError."""
    loop = asyncio.get_running_loop()
    wire_time = has_wire_time(options.port) and wire_time
    line = simulated_line(options, models, loop, wire_time=wire_time)
    # An echo comes from the injector, which keeps no wire time.
    early = options.faults is not None and options.faults.echo > 0
    traits = LineTraits(options.baudrate if wire_time else None, paced=wire_time and not early, can_change_baud=True)
    return SimulatedLink(far_end(options, line, loop), traits, options.port, line)
