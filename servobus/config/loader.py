"""Reads a bus config: YAML within limits -> frozen options and models, or a ConfigError that lists every problem.

Each problem has a file, a line and a column. The options of `protocols` define the keys; `checks` has the rules that need several
keys.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, TypeAdapter

from servobus.config.access import AccessOptions, DoorOptions
from servobus.config.checks import check_models, check_ports
from servobus.documents import reader
from servobus.documents.problems import Problems, quote, valid_subset
from servobus.documents.reader import KeyPath
from servobus.protocols.model import ServoModel
from servobus.protocols.options import BusOptions, Name
from servobus.protocols.registry import PROTOCOLS

P = TypeVar("P", bound=BaseModel)
VERSION = 1
KEYS = ("version", "buses", "access", "door")
REQUIRED = ("version", "buses")
_name = TypeAdapter(Name)


@dataclass(frozen=True, slots=True)
class Config:
    """The config of a whole rig."""

    version: int
    buses: Mapping[str, BusOptions]
    models: Mapping[str, Mapping[str, ServoModel]]  # bus -> model name -> model
    access: AccessOptions = field(default_factory=AccessOptions)
    door: DoorOptions = field(default_factory=DoorOptions)

    @property
    def names(self) -> dict[str, tuple[str, str]]:
        """bus/servo -> (bus, servo), in the order of the file."""
        return {f"{bus}/{servo}": (bus, servo) for bus, options in self.buses.items() for servo in options.servos}

    def has_same_line(self, bus: str, other: Config) -> bool:
        """Whether both configs have this bus, with the same line, ids, models and calibration; other keys may differ."""
        if bus not in self.buses or bus not in other.buses:
            return False
        return self.buses[bus].is_live_change(other.buses[bus]) and self.models[bus] == other.models[bus]


def load_config(path: str | Path) -> Config:
    """Read the config in a file. Model files are relative to its folder. Raises ConfigError."""
    return _config(reader.read(path), Path(path).parent)


def parse_config(text: str | bytes, name: str, folder: Path = Path()) -> Config:
    """Read the config in a text; messages call it `name`. Raises ConfigError."""
    return _config(reader.parse(text, name), folder)


def _config(document: reader.Document, folder: Path) -> Config:
    problems = Problems(document)
    data = _top_level(document.data, problems)
    buses: dict[str, BusOptions] = {}
    models: dict[str, Mapping[str, ServoModel]] = {}
    for name, bus_data in _bus_items(data, problems):
        options = _bus(name, bus_data, problems)
        if options is not None:
            buses[str(name)] = options
            models[str(name)] = check_models(("buses", name), options, folder, problems)
    check_ports(buses, problems)
    access = _section(AccessOptions, "access", data, problems)
    door = _section(DoorOptions, "door", data, problems)
    problems.raise_any()
    return Config(VERSION, buses, models, access, door)


def _section(kind: type[P], key: str, data: Mapping[Any, Any], problems: Problems) -> P:
    """An optional section; its defaults where it is omitted or wrong."""
    return (problems.validated(kind, data[key], (key,)) if key in data else None) or kind()


def _top_level(data: Any, problems: Problems) -> Mapping[Any, Any]:
    """Checks the keys of the file and its version; empty where the file is not a mapping."""
    if not isinstance(data, dict):
        problems.add((), f"found {quote(data)}; a config begins with `version: 1` and has `buses:`")
        return {}
    for key in data:
        if key not in KEYS:
            problems.add((key,), f"unknown key; there are {', '.join(KEYS)}", key=True)
    version = data.get("version")
    if version != VERSION or isinstance(version, bool):
        problems.add(("version",), f"found version {quote(version)}; write `version: {VERSION}`")
    return data


def _bus_items(data: Mapping[Any, Any], problems: Problems) -> list[tuple[str | int, Any]]:
    buses = data.get("buses")
    if isinstance(buses, dict) and buses:
        return list(buses.items())
    if data:
        problems.add(("buses",), "no buses; name at least one under `buses:`")
    return []


def _bus(name: str | int, data: Any, problems: Problems) -> BusOptions | None:
    """The options of a bus; of a bus with mistakes, the part that can be checked further."""
    path: KeyPath = ("buses", name)
    if not _is_name(name, path, problems):
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


def _is_name(name: str | int, path: KeyPath, problems: Problems) -> bool:
    if not isinstance(name, str):
        problems.add(path, f"found {quote(name)} as a name; put it in quotes", key=True)
        return False
    try:
        _name.validate_python(name)
    except ValueError:
        problems.add(path, "a name is letters, digits, . _ - and begins with a letter or digit", key=True)
        return False
    return True
