"""YAML bus configs: read within limits, checked whole, every mistake named by file, line and column.

What a key means stands in `protocols/options.py` and beside each protocol; what only a whole file shows stands here: two buses on
one port, two servos with one id, limits that a model cannot reach.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, TypeAdapter

from servobus.config.access import AccessOptions, DoorOptions
from servobus.documents import reader
from servobus.documents.problems import Problems, quote, valid_subset
from servobus.documents.reader import KeyPath
from servobus.errors import ConfigError, ServobusError
from servobus.links import TUNNELS, check_port
from servobus.protocols.model import ServoModel
from servobus.protocols.options import BusOptions, Name, ServoOptions
from servobus.protocols.registry import PROTOCOLS
from servobus.simulation.link import SIMULATED, has_wire_time

P = TypeVar("P", bound=BaseModel)
VERSION = 1
KEYS = ("version", "buses", "access", "door")
REQUIRED = ("version", "buses")
_name = TypeAdapter(Name)


@dataclass(frozen=True, slots=True)
class Config:
    """A whole rig."""

    version: int
    buses: Mapping[str, BusOptions]
    models: Mapping[str, Mapping[str, ServoModel]]
    """Bus -> model name -> model."""
    access: AccessOptions = field(default_factory=AccessOptions)
    door: DoorOptions = field(default_factory=DoorOptions)

    @property
    def names(self) -> dict[str, tuple[str, str]]:
        """bus/servo -> (bus, servo), in the order of the file."""
        return {f"{bus}/{servo}": (bus, servo) for bus, options in self.buses.items() for servo in options.servos}

    def has_same(self, bus: str, other: Config) -> bool:
        """Nothing differs on this bus."""
        if bus not in self.buses or bus not in other.buses:
            return False
        return self.buses[bus] == other.buses[bus] and self.models[bus] == other.models[bus]


def load_config(path: str | Path) -> Config:
    """The config in a file; model files are looked for beside it. Raises ConfigError."""
    return _config(reader.read(path), Path(path).parent)


def parse_config(text: str | bytes, name: str, folder: Path = Path()) -> Config:
    """The config in a text; `name` stands in messages. Raises ConfigError."""
    return _config(reader.parse(text, name), folder)


def _config(document: reader.Document, folder: Path) -> Config:
    problems = Problems(document)
    buses: dict[str, BusOptions] = {}
    models: dict[str, Mapping[str, ServoModel]] = {}
    for name, data in _bus_entries(document.data, problems):
        options = _bus(name, data, problems)
        if options is not None:
            buses[str(name)] = options
            models[str(name)] = _models(("buses", name), options, folder, problems)
    _check_ports(buses, problems)
    data = document.data if isinstance(document.data, dict) else {}
    access = _part(AccessOptions, "access", data, problems)
    door = _part(DoorOptions, "door", data, problems)
    problems.raise_any()
    return Config(VERSION, buses, models, access, door)


def _part(kind: type[P], key: str, data: Mapping[Any, Any], problems: Problems) -> P:
    """What the daemon's keys say; all of them may be left out."""
    return (problems.validated(kind, data[key], (key,)) if key in data else None) or kind()


def _bus_entries(data: Any, problems: Problems) -> list[tuple[str | int, Any]]:
    if not isinstance(data, dict):
        problems.add((), f"found {quote(data)}; a config begins with `version: 1` and has `buses:`")
        return []
    for key in data:
        if key not in KEYS:
            problems.add((key,), f"unknown key; there are {', '.join(KEYS)}", key=True)
    if data.get("version") != VERSION or isinstance(data.get("version"), bool):
        where: KeyPath = ("version",) if "version" in data else ()
        problems.add(where, f"found version {quote(data.get('version'))}; write `version: {VERSION}`")
    buses = data.get("buses")
    if not isinstance(buses, dict) or not buses:
        problems.add(("buses",) if "buses" in data else (), "no buses; name at least one under `buses:`")
        return []
    return list(buses.items())


def _bus(name: str | int, data: Any, problems: Problems) -> BusOptions | None:
    """The options of a bus; of a bus with mistakes, what else can be checked."""
    path: KeyPath = ("buses", name)
    if not isinstance(name, str):
        problems.add(path, f"found {quote(name)} as a name; put it in quotes", key=True)
        return None
    try:
        _name.validate_python(name)
    except ValueError:
        problems.add(path, "a name is letters, digits, . _ - and begins with a letter or digit", key=True)
        return None
    if not isinstance(data, dict):
        problems.add(path, f"found {quote(data)}; a bus has the keys protocol, port, baudrate, servos")
        return None
    protocol = data.get("protocol")
    if not isinstance(protocol, str) or protocol not in PROTOCOLS:
        where = (*path, "protocol") if "protocol" in data else path
        problems.add(where, f"found protocol {quote(protocol)}; there are {', '.join(PROTOCOLS)}")
        return None
    kind = PROTOCOLS[protocol].options
    options: BusOptions | None = problems.validated(kind, data, path) or valid_subset(kind, data)
    return options


def _models(path: KeyPath, options: BusOptions, folder: Path, problems: Problems) -> Mapping[str, ServoModel]:
    """The models of a bus, and what its servos want that those cannot do."""
    found, refused = _find_models(options, folder)
    owners: dict[Any, str] = {}
    told: dict[str, str] = {}
    for servo, entry in options.servos.items():
        here = (*path, "servos", servo)
        owner = owners.setdefault(entry.key, servo)
        if owner != servo:
            problems.add((*here, "id"), f"found id {entry.id} again (it is {owner}'s); each servo has its own")
        if servo in refused:
            first = told.setdefault(refused[servo], servo)
            problems.add((*here, "model"), refused[servo] if first == servo else f"cannot be used, see {first}")
        else:
            _check_servo(here, entry, found[entry.model], problems)
    return found


def _find_models(options: BusOptions, folder: Path) -> tuple[dict[str, ServoModel], dict[str, str]]:
    """The models by name, and by servo what was refused: when all together are not accepted, each alone is asked for."""
    models = PROTOCOLS[options.protocol].models
    found: dict[str, ServoModel] = {}
    refused: dict[str, str] = {}
    try:
        return dict(models(options, folder)), refused
    except ConfigError:
        for servo, entry in options.servos.items():
            try:
                found.update(models(options.model_copy(update={"servos": {servo: entry}}), folder))
            except ConfigError as error:
                refused[servo] = error.message
    return found, refused


def _check_servo(here: KeyPath, servo: ServoOptions, model: ServoModel, problems: Problems) -> None:
    """What this model cannot do, or the wire cannot carry."""
    if servo.unit is not None and servo.unit not in model.units:
        problems.add((*here, "unit"), f"found {quote(servo.unit)}; model {model.name} has {', '.join(model.units)}")
        return
    calibration = servo.calibration(model)
    ranges = model.goal_ranges
    if "position" in ranges:
        ends = sorted(calibration.to_unit(raw) for raw in ranges["position"])
        for key, values in (("limits", servo.limits or ()), ("park_pose", [servo.park_pose])):
            for value in values:
                if value is not None and not ends[0] <= value <= ends[1]:
                    problems.add((*here, key), f"found {value:g}; model {model.name} reaches {ends[0]:g} to {ends[1]:g}")
    greatest = {
        "speed": abs(calibration.rate_to_unit(ranges["speed"][1])) if "speed" in ranges else None,
        "max_speed": abs(calibration.rate_to_unit(ranges["speed"][1])) if "speed" in ranges else None,
        "acceleration": ranges["acceleration"][1] * calibration.unit_per_step if "acceleration" in ranges else None,
        "torque_limit": ranges["torque_limit"][1] if "torque_limit" in ranges else None,
    }
    for key, most in greatest.items():
        value = getattr(servo, key)
        if value is not None and most is not None and value > most:
            told = f"model {model.name} takes at most {most:g}" if most else f"model {model.name} has none"
            problems.add((*here, key), f"found {value:g}; {told}")


def _check_tunnel(options: BusOptions) -> None:
    scheme = options.port.partition(":")[0]
    passes = TUNNELS.get(scheme, options.protocol)
    if passes != options.protocol:
        raise ConfigError(f"{scheme}:// passes {passes} on and nothing else; {options.protocol} needs a line of its own")


def _check_ports(buses: Mapping[str, BusOptions], problems: Problems) -> None:
    """Each line has one owner, by whatever name it goes."""
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
