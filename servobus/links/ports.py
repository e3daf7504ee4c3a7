"""Which serial ports this machine has, by every name they go under, and who holds them."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from serial.tools import list_ports as serial_ports
from serial.tools.list_ports_common import ListPortInfo

from servobus.links.tty import find_holder

LINK_FOLDERS = (Path("/dev/serial/by-id"), Path("/dev/serial/by-path"))
"""Where udev puts names that stay the same whatever is plugged in first."""


@dataclass(frozen=True, slots=True)
class PortInfo:
    """One port. What the system does not tell is None."""

    device: str
    by_id: str | None
    """The name to write into a config: it belongs to the adapter."""
    by_path: str | None
    """The name that belongs to the socket the adapter is plugged into."""
    description: str | None
    manufacturer: str | None
    serial_number: str | None
    vid: int | None
    pid: int | None
    holder: tuple[int, str] | None
    """Process that has it open, and its name."""


def list_ports() -> list[PortInfo]:
    """In the order of their device names."""
    by_id, by_path = (links_in(folder) for folder in LINK_FOLDERS)
    return [describe(port, by_id, by_path) for port in sorted(serial_ports.comports())]


def describe(port: ListPortInfo, by_id: Mapping[str, str], by_path: Mapping[str, str]) -> PortInfo:
    """What pyserial found, together with its other names and its holder."""
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
    """Device -> link that leads to it; none where udev made no such folder."""
    try:
        return {os.path.realpath(link): str(link) for link in sorted(folder.iterdir())}
    except OSError:
        return {}
