"""The path of the daemon's socket."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

FILE = "servobus.sock"


def socket_path(environ: Mapping[str, str] = os.environ) -> Path:
    """The path at which a daemon that starts now listens."""
    return _paths(environ)[0]


def find_socket(environ: Mapping[str, str] = os.environ) -> Path | None:
    """The path of a socket that exists: the user's before the system's; None: there is none."""
    return next((path for path in _paths(environ) if path.is_socket()), None)


def _paths(environ: Mapping[str, str]) -> list[Path]:
    """SERVOBUS_SOCKET alone where it is set; else in the folder that systemd made, the user's, the system's."""
    if environ.get("SERVOBUS_SOCKET"):
        return [Path(environ["SERVOBUS_SOCKET"])]
    paths = [Path("/run/servobus") / FILE]
    if environ.get("XDG_RUNTIME_DIR"):
        paths.insert(0, Path(environ["XDG_RUNTIME_DIR"]) / "servobus" / FILE)
    if environ.get("RUNTIME_DIRECTORY"):
        paths.insert(0, Path(environ["RUNTIME_DIRECTORY"].split(":")[0]) / FILE)
    return paths
