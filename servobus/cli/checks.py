"""What a command checks in a config before a port is opened: goals, registers, and the load of each line."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from servobus.bus.bandwidth import Bandwidth, line_bandwidth
from servobus.bus.limits import check_goal
from servobus.config.loader import Config
from servobus.errors import ServobusError
from servobus.links import open_link
from servobus.protocols.base import Driver, LineTraits
from servobus.protocols.options import BusOptions
from servobus.protocols.registry import PROTOCOLS
from servobus.rig.interface import full_name
from servobus.simulation.link import SIMULATED
from servobus.values import Goal, ServoGoal


def check_goals(config: Config, positions: Mapping[str, float], speed: float | None, duration: float | None) -> None:
    """Raises LimitError or NotSupported for a position (by full name) that its servo may not take."""
    for name, position in positions.items():
        bus, servo = config.names[name]
        try:
            goal = check_goal(servo, Goal("position", position, speed, duration), config.buses[bus].servos[servo], None)
            _driver(config, bus).check_goal(ServoGoal(servo, goal))
        except ServobusError as error:
            raise error.at(bus=bus) from None


def check_registers(config: Config, name: str, values: Mapping[str, Any], *, raw: bool, persist: bool) -> None:
    """Raises LimitError, UnknownName or NotSupported for a value that its register may not take."""
    bus, servo = config.names[full_name(config.names, name)]
    driver = _driver(config, bus)
    for register, value in values.items():
        try:
            driver.write_register(servo, register, value, raw=raw, persist=persist).close()
        except ServobusError as error:
            raise error.at(bus=bus, servo=servo) from None


def line_loads(config: Config) -> dict[str, Bandwidth]:
    """What each bus must carry with the rates of the config."""
    return {name: line_bandwidth(options, _driver(config, name), _line_traits(options)) for name, options in config.buses.items()}


def _driver(config: Config, bus: str) -> Driver:
    options = config.buses[bus]
    return PROTOCOLS[options.protocol].driver(options, config.models[bus])


def _line_traits(options: BusOptions) -> LineTraits:
    if options.port.startswith(SIMULATED):
        return LineTraits(options.baudrate)
    return open_link(options.port, options.baudrate, rs485=options.rs485).traits
