"""What a protocol folder offers to the floors above: the shape of a line of `table.py`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

from servobus.protocols.base import Codec, Device, Driver
from servobus.protocols.model import ServoModel
from servobus.protocols.options import BusOptions


def one_servo(node: int, model: str) -> dict[str, dict[str, Any]]:
    """A node that is one servo."""
    return {f"servo_{node}": {"id": node, "model": model}}


@dataclass(frozen=True, slots=True)
class ProtocolDefinition:
    """The parts of one protocol. `options` below is always an instance of its own options class."""

    options: type[BusOptions]
    """Its YAML keys."""
    models: Callable[[Any, Path], Mapping[str, ServoModel]]
    """(options, the config's folder) -> every model its servos name, by that name. Raises ConfigError."""
    codec: Callable[[Any], Codec]
    """For the master's end of the line, with the options of its bus; None: as the documents have it."""
    driver: Callable[[Any, Mapping[str, Any]], Driver]
    device_codec: Callable[[Any], Codec]
    """For the devices' end of the line, likewise."""
    devices: Callable[[Any, Mapping[str, Any]], Sequence[Device]]
    """The simulated halves of the bus's servos."""
    rename: Callable[[bytes, Random], bytes]
    """A reply frame in the name of another node, checksum right: for the fault injector."""
    node_of: Callable[[bytes], int]
    """The node that a reply frame names."""
    baudrates: tuple[int, ...]
    """Rates a scan tries, the likely ones first."""
    scan_ids: range
    starter: Callable[[int, str], Mapping[str, Mapping[str, Any]]] = one_servo
    """(id, model) of what a scan found -> its servos, by name, as the YAML of a config."""
