"""Where the daemon's socket is."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

FILE = "servobus.sock"


def socket_path(environ: Mapping[str, str] = os.environ) -> Path:
    """SERVOBUS_SOCKET, else in the folder systemd made for the service, else in the user's, else in the system's."""
    if environ.get("SERVOBUS_SOCKET"):
        return Path(environ["SERVOBUS_SOCKET"])
    if environ.get("RUNTIME_DIRECTORY"):
        return Path(environ["RUNTIME_DIRECTORY"].split(":")[0]) / FILE
    if environ.get("XDG_RUNTIME_DIR"):
        return Path(environ["XDG_RUNTIME_DIR"]) / "servobus" / FILE
    return Path("/run/servobus") / FILE
