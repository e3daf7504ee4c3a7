"""The rules of a config that need more than one key: the limits of a servo's model, ids of a bus, ports of all buses."""

from __future__ import annotations

import os
from collections.abc import Hashable, Mapping
from pathlib import Path

from servobus.documents.problems import Problems, quote
from servobus.documents.reader import KeyPath
from servobus.errors import ConfigError, ServobusError
from servobus.links import TUNNELS, check_port
from servobus.protocols.model import ServoModel
from servobus.protocols.options import BusOptions, ServoOptions
from servobus.protocols.registry import PROTOCOLS
from servobus.simulation.link import SIMULATED, has_wire_time
from servobus.values import Calibration

POSITION_KEYS = ("limits", "park_pose")
MAXIMUM_KEYS = {"speed": "speed", "max_speed": "speed", "acceleration": "acceleration", "torque_limit": "torque_limit"}
"""Key of a servo -> the range of `ServoModel.goal_ranges` whose end it may not exceed."""


def check_models(path: KeyPath, options: BusOptions, folder: Path, problems: Problems) -> Mapping[str, ServoModel]:
    """Load the models of a bus, and add a problem for each servo whose id is used twice or whose model cannot do what it asks."""
    models, refused = _load_models(options, folder)
    owners: dict[Hashable, str] = {}
    first_refused: dict[str, str] = {}
    for name, servo in options.servos.items():
        here = (*path, "servos", name)
        owner = owners.setdefault(servo.key, name)
        if owner != name:
            problems.add((*here, "id"), f"found id {servo.id} again (it is {owner}'s); each servo has its own")
        if name in refused:
            first = first_refused.setdefault(refused[name], name)
            problems.add((*here, "model"), refused[name] if first == name else f"cannot be used, see {first}")
        else:
            _check_servo(here, servo, models[servo.model], problems)
    return models


def _load_models(options: BusOptions, folder: Path) -> tuple[dict[str, ServoModel], dict[str, str]]:
    """The models by name, and the refusal by servo. Where loading all at once fails, each servo's model is loaded alone."""
    load = PROTOCOLS[options.protocol].models
    models: dict[str, ServoModel] = {}
    refused: dict[str, str] = {}
    try:
        return dict(load(options, folder)), refused
    except ConfigError:
        for name, servo in options.servos.items():
            try:
                models.update(load(options.model_copy(update={"servos": {name: servo}}), folder))
            except ConfigError as error:
                refused[name] = error.message
    return models, refused


def _check_servo(here: KeyPath, servo: ServoOptions, model: ServoModel, problems: Problems) -> None:
    """Adds a problem for each key that asks for more than the model can do."""
    if servo.unit is not None and servo.unit not in model.units:
        problems.add((*here, "unit"), f"found {quote(servo.unit)}; model {model.name} has {', '.join(model.units)}")
        return
    calibration = servo.calibration(model)
    _check_positions(here, servo, model, calibration, problems)
    for key, maximum in _maxima(model, calibration).items():
        value = getattr(servo, key)
        if value is not None and value > maximum:
            expected = f"model {model.name} takes at most {maximum:g}" if maximum else f"model {model.name} has none"
            problems.add((*here, key), f"found {value:g}; {expected}")


def _check_positions(here: KeyPath, servo: ServoOptions, model: ServoModel, calibration: Calibration, problems: Problems) -> None:
    if "position" not in model.goal_ranges:
        return
    low, high = sorted(calibration.to_unit(raw) for raw in model.goal_ranges["position"])
    for key, values in zip(POSITION_KEYS, (servo.limits or (), [servo.park_pose]), strict=True):
        for value in values:
            if value is not None and not low <= value <= high:
                problems.add((*here, key), f"found {value:g}; model {model.name} reaches {low:g} to {high:g}")


def _maxima(model: ServoModel, calibration: Calibration) -> dict[str, float]:
    """Key of a servo -> the highest value that the model takes, in the servo's unit; absent where it is not known."""
    ranges = model.goal_ranges
    unit_per_step = {"speed": calibration.unit_per_step, "acceleration": calibration.unit_per_step, "torque_limit": 1.0}
    return {key: ranges[part][1] * unit_per_step[part] for key, part in MAXIMUM_KEYS.items() if part in ranges}


def check_ports(buses: Mapping[str, BusOptions], problems: Problems) -> None:
    """Add a problem for each port that cannot be used, and for each that two buses use by whatever name."""
    owners: dict[str, str] = {}
    for name, options in buses.items():
        path: KeyPath = ("buses", name, "port")
        try:
            if options.port.startswith(SIMULATED):
                has_wire_time(options.port)
                continue
            check_port(options.port)
            _check_tunnel(options)
        except ServobusError as error:
            problems.add(path, error.message.replace(repr(options.port), quote(options.port)))
            continue
        owner = owners.setdefault(os.path.realpath(options.port), name)
        if owner != name:
            problems.add(path, f"found the port of bus {owner} again; put its servos into one bus, a line has one owner")


def _check_tunnel(options: BusOptions) -> None:
    scheme = options.port.partition(":")[0]
    carried = TUNNELS.get(scheme, options.protocol)
    if carried != options.protocol:
        raise ConfigError(f"{scheme}:// carries {carried} alone; {options.protocol} needs a line of its own")
