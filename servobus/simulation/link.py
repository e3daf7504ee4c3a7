"""Links to simulated lines, made from the options of a bus.

`port: "sim:"` is a line on which bytes take their wire time; with `port: "sim:?wire_time=off"` they take none.
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
"""Address of a simulated line -> whether bytes take their wire time on it."""


def has_wire_time(port: str) -> bool:
    """Return whether bytes take their wire time. Raises ConfigError for another address."""
    try:
        return PORTS[port]
    except KeyError:
        forms = " or ".join(f'"{form}"' for form in PORTS)
        raise ConfigError(f"port {port!r} is not a simulated line: write {forms}") from None


def simulated_line(
    options: BusOptions, models: Mapping[str, ServoModel], loop: asyncio.AbstractEventLoop, *, wire_time: bool = True
) -> SimulatedLine:
    """Return a line with the servos of a bus, each at its zero position."""
    protocol = PROTOCOLS[options.protocol]
    devices = protocol.devices(options, models)
    return SimulatedLine(
        devices,
        protocol.device_codec(options),
        loop,
        baudrate=options.baudrate,
        wire_time=wire_time,
        four_wires=options.spread is not None,
    )


def far_end(options: BusOptions, line: SimulatedLine, loop: asyncio.AbstractEventLoop) -> FarEnd:
    """Return the line, behind a fault injector if the options ask for one."""
    if options.faults is None:
        return line
    protocol = PROTOCOLS[options.protocol]
    return FaultyEnd(line, options.faults, loop, rename=protocol.rename, node_of=protocol.node_of)


class SimulatedLink(MemoryLink):
    """A link to a simulated line. The line and the state of its servos outlive each connection."""

    def __init__(self, far: FarEnd, traits: LineTraits, address: str, line: SimulatedLine) -> None:
        super().__init__(far, traits, address)
        self.line = line
        self._baudrate = line.baudrate

    async def connect(self, protocol: asyncio.Protocol) -> MemoryTransport:
        """Open the line at the rate of the config, as a serial port is opened, whatever rate was set before."""
        transport = await super().connect(protocol)
        self.line.set_baudrate(self._baudrate)
        return transport

    def close(self) -> None:
        """End the line for good."""
        self.line.close()


def simulated_link(options: BusOptions, models: Mapping[str, ServoModel], *, wire_time: bool = True) -> SimulatedLink:
    """Return a link to a new simulated line. Call it in a running loop.

    `wire_time=False`: bytes take no time, whatever the port says. Raises ConfigError for a port that is not simulated.
    """
    loop = asyncio.get_running_loop()
    wire_time = has_wire_time(options.port) and wire_time
    line = simulated_line(options, models, loop, wire_time=wire_time)
    # The fault injector makes the echo, and it does not keep wire time.
    early = options.faults is not None and options.faults.echo > 0
    traits = LineTraits(options.baudrate if wire_time else None, paced=wire_time and not early, can_change_baud=True)
    return SimulatedLink(far_end(options, line, loop), traits, options.port, line)
