"""The serial ports of this machine: their names, what the system knows about each adapter, and the process that has it open."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from serial.tools import list_ports as serial_ports
from serial.tools.list_ports_common import ListPortInfo

from servobus.links.tty import find_holder

LINK_FOLDERS = (Path("/dev/serial/by-id"), Path("/dev/serial/by-path"))
"""Folders of udev links whose names do not depend on the order in which adapters are plugged in."""


@dataclass(frozen=True, slots=True)
class PortInfo:
    """One port. A field is None where the system does not know it."""

    device: str
    by_id: str | None
    """The link named after the adapter (maker, product, serial number): the best name for a config."""
    by_path: str | None
    """The link named after the socket that the adapter is plugged into."""
    description: str | None
    manufacturer: str | None
    serial_number: str | None
    vid: int | None
    pid: int | None
    holder: tuple[int, str] | None
    """Process id and name of the program that has it open."""


def list_ports() -> list[PortInfo]:
    """Return the ports in the order of their device names."""
    by_id, by_path = (links_in(folder) for folder in LINK_FOLDERS)
    return [describe(port, by_id, by_path) for port in sorted(serial_ports.comports())]


def describe(port: ListPortInfo, by_id: Mapping[str, str], by_path: Mapping[str, str]) -> PortInfo:
    """Return what pyserial reports about a port, with its other names and its holder."""
    return PortInfo(
        device=port.device,
        by_id=by_id.get(port.device),
        by_path=by_path.get(port.device),
        description=None if port.description == "n/a" else port.description,
        manufacturer=port.manufacturer,
        serial_number=port.serial_number,
        vid=port.vid,
        pid=port.pid,
        holder=find_holder(port.device),
    )


def links_in(folder: Path) -> dict[str, str]:
    """Return device -> link to it. Empty where the folder does not exist."""
    try:
        return {os.path.realpath(link): str(link) for link in sorted(folder.iterdir())}
    except OSError:
        return {}
