"""Which serial ports this machine has, by every name they go under, and who holds them."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from serial.tools import list_ports as serial_ports

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
    by_id, by_path = (_links(folder) for folder in LINK_FOLDERS)
    return [
        PortInfo(
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
        for port in sorted(serial_ports.comports())
    ]


def find_holder(path: str) -> tuple[int, str] | None:
    """Another process that has this device open, and its name, as far as this user may see."""
    try:
        wanted = os.stat(path)
    except OSError:
        return None
    own = os.getpid()
    for process in Path("/proc").glob("[0-9]*"):
        pid = int(process.name)
        if pid != own and any(_same(wanted, found) for found in _open_files(process)):
            return pid, _name(process)
    return None


def _open_files(process: Path) -> Iterator[os.stat_result]:
    try:
        for descriptor in (process / "fd").iterdir():
            try:
                yield descriptor.stat()
            except OSError:
                continue  # closed meanwhile
    except OSError:
        return  # ended meanwhile, or another user's


def _same(one: os.stat_result, other: os.stat_result) -> bool:
    return one.st_rdev == other.st_rdev and one.st_ino == other.st_ino and one.st_dev == other.st_dev


def _name(process: Path) -> str:
    try:
        return (process / "comm").read_text().strip()
    except OSError:
        return "unknown"


def _links(folder: Path) -> dict[str, str]:
    """Device -> link that leads to it."""
    try:
        return {os.path.realpath(link): str(link) for link in sorted(folder.iterdir())}
    except OSError:
        return {}
