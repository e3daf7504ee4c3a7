"""What a protocol package offers to the packages above: one `ProtocolDefinition`, listed in `registry.py`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

from servobus.protocols.base import Codec, Driver
from servobus.protocols.device import Device
from servobus.protocols.model import ServoModel
from servobus.protocols.options import BusOptions


def one_servo(node: int, model: str) -> dict[str, dict[str, Any]]:
    """Return the YAML of a node that is one servo."""
    return {f"servo_{node}": {"id": node, "model": model}}


@dataclass(frozen=True, slots=True)
class ProtocolDefinition:
    """The parts of one protocol. The options passed to them are an instance of its options class."""

    options: type[BusOptions]
    """The class of its YAML keys."""
    models: Callable[[Any, Path], Mapping[str, ServoModel]]
    """(options, folder of the config) -> every model that the servos name, by that name. Raises ConfigError."""
    codec: Callable[[Any], Codec]
    """(options or None) -> the codec of the master's end of the line; None: as the documents describe it."""
    driver: Callable[[Any, Mapping[str, Any]], Driver]
    """(options, models) -> the driver of a bus."""
    device_codec: Callable[[Any], Codec]
    """The codec of the devices' end of the line, likewise."""
    devices: Callable[[Any, Mapping[str, Any]], Sequence[Device]]
    """(options, models) -> the simulated nodes of a bus."""
    rename: Callable[[bytes, Random], bytes]
    """(reply frame, random) -> the frame with the id of another node and a right checksum, for the fault injector."""
    node_of: Callable[[bytes], int]
    """(reply frame) -> the id in it."""
    baudrates: tuple[int, ...]
    """Baud rates that a scan tries, the likely ones first."""
    scan_ids: range
    starter: Callable[[int, str], Mapping[str, Mapping[str, Any]]] = one_servo
    """(id, model) of a node that a scan found -> its servos by name, as the YAML of a config."""
