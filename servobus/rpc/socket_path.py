"""Where the daemon's socket is."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

FILE = "servobus.sock"


def socket_path(environ: Mapping[str, str] = os.environ) -> Path:
    """Where a daemon that is started now makes it."""
    return _places(environ)[0]


def find_socket(environ: Mapping[str, str] = os.environ) -> Path | None:
    """Where one is: the user's own before the system's. None: nowhere."""
    return next((place for place in _places(environ) if place.is_socket()), None)


def _places(environ: Mapping[str, str]) -> list[Path]:
    """SERVOBUS_SOCKET alone where it is set; else the folder systemd made for the service, the user's, the system's."""
    if environ.get("SERVOBUS_SOCKET"):
        return [Path(environ["SERVOBUS_SOCKET"])]
    places = [Path("/run/servobus") / FILE]
    if environ.get("XDG_RUNTIME_DIR"):
        places.insert(0, Path(environ["XDG_RUNTIME_DIR"]) / "servobus" / FILE)
    if environ.get("RUNTIME_DIRECTORY"):
        places.insert(0, Path(environ["RUNTIME_DIRECTORY"].split(":")[0]) / FILE)
    return places
