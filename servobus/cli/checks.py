"""What a command checks in a config before a port is opened: goals, registers, and the load of each line."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from servobus.bus.bandwidth import Bandwidth, line_bandwidth
from servobus.bus.limits import check_goal
from servobus.config.loader import Config
from servobus.errors import DeviceError, ServobusError
from servobus.links import open_link
from servobus.protocols.base import Driver, LineTraits
from servobus.protocols.options import BusOptions
from servobus.protocols.registry import PROTOCOLS
from servobus.rig.interface import Rig, full_name
from servobus.rig.local import LocalRig
from servobus.rig.results import raise_failures
from servobus.simulation.link import SIMULATED
from servobus.values import Goal, ServoGoal


def check_goals(config: Config, positions: Mapping[str, float], speed: float | None, duration: float | None) -> None:
    """Raises LimitError or NotSupported for a position (by full name) that its servo may not take.

    What only a servo itself can tell is checked by `check_servos`.
    """
    for name, position in positions.items():
        bus, servo = config.names[name]
        with suppress(DeviceError):  # a hand has to be asked for its register map first
            _check_goal(_driver(config, bus), config.buses[bus], (bus, servo), Goal("position", position, speed, duration))


async def check_servos(rig: Rig, positions: Mapping[str, float], speed: float | None, duration: float | None) -> None:
    """Ask each servo (by full name) what it is, and check its goal by that: in its mode, within its own limits.

    Nothing is written, so nothing is energised where a servo is gone or cannot take its goal. Raises what refuses any of them.
    """
    assert isinstance(rig, LocalRig)
    answers = await asyncio.gather(*map(rig.identify, positions), return_exceptions=True)
    raise_failures(dict(zip(positions, answers, strict=True)))
    for name, position in positions.items():
        bus, servo = rig.names[name]
        service = rig.buses[bus]
        _check_goal(service.driver, service.options, (bus, servo), Goal("position", position, speed, duration))


def _check_goal(driver: Driver, options: BusOptions, servo: tuple[str, str], goal: Goal) -> None:
    """The value is checked, not the way to it: it is taken to be short."""
    bus, name = servo
    try:
        driver.check_goal(ServoGoal(name, check_goal(name, goal, options.servos[name], None), start=goal.value))
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
