"""What a command checks in a config before a port is opened: goals, registers, buses, and the load of each line."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import click

from servobus.bus.bandwidth import Bandwidth, line_bandwidth
from servobus.bus.limits import check_goal
from servobus.config.loader import Config
from servobus.errors import NotSupported, ServobusError, UnknownName
from servobus.links import open_link
from servobus.protocols.base import Driver, LineTraits
from servobus.protocols.options import BusOptions
from servobus.protocols.registry import PROTOCOLS
from servobus.rig.interface import full_name
from servobus.simulation.link import SIMULATED
from servobus.values import Goal, ServoGoal


def check_goals(config: Config, positions: Mapping[str, float], speed: float | None, duration: float | None) -> None:
    """Raises LimitError, UnknownName or NotSupported for a goal that its servo may not take."""
    for name, position in by_full_name(positions, lambda name: full_name(config.names, name)).items():
        bus, servo = config.names[name]
        try:
            goal = check_goal(servo, Goal("position", position, speed, duration), config.buses[bus].servos[servo], None)
            _driver(config, bus).check_goal(ServoGoal(servo, goal))
        except ServobusError as error:
            raise error.at(bus=bus) from None


def by_full_name(positions: Mapping[str, float], full: Callable[[str], str]) -> dict[str, float]:
    """The same positions by full name. Raises BadParameter where two names mean one servo."""
    goals: dict[str, float] = {}
    for name, position in positions.items():
        if full(name) in goals:
            raise click.BadParameter(f"{full(name)} is named twice: give each servo one position", param_hint="NAME=POSITION")
        goals[full(name)] = position
    return goals


def check_registers(config: Config, name: str, values: Mapping[str, Any], *, raw: bool, persist: bool) -> None:
    """Raises LimitError, UnknownName or NotSupported for a value that its register may not take."""
    bus, servo = config.names[full_name(config.names, name)]
    driver = _driver(config, bus)
    for register, value in values.items():
        try:
            driver.write_register(servo, register, value, raw=raw, persist=persist).close()
        except ServobusError as error:
            raise error.at(bus=bus, servo=servo) from None


def check_bus(config: Config, bus: str) -> None:
    """Raises UnknownName for a bus that the config does not have."""
    if bus not in config.buses:
        raise UnknownName(f"no bus {bus!r}: there are {', '.join(config.buses)}")


def refuse_clear(config: Config) -> None:
    """Raises NotSupported: without a daemon no e-stop is latched."""
    buses = ", ".join(config.buses)
    raise NotSupported(f"no e-stop is latched on {buses}: no daemon runs (`servobus run`), and only a daemon latches one")


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
