"""Where the daemon is: the address that a person named, else the path of its socket."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from servobus.errors import ConfigError

FILE = "servobus.sock"
VARIABLE = "SERVOBUS_SOCKET"


def named_daemon(environ: Mapping[str, str] = os.environ) -> str | None:
    """The address of the daemon that SERVOBUS_SOCKET names, a path or tcp://host:port; None: it names none."""
    return environ.get(VARIABLE) or None


def socket_path(environ: Mapping[str, str] = os.environ) -> Path:
    """The path at which a daemon that starts now listens. Raises ConfigError where SERVOBUS_SOCKET is no path."""
    named = named_daemon(environ)
    if named and "://" in named:
        raise ConfigError(
            f"{VARIABLE} is {named}: a daemon listens at a path; unset it, and use `door: tcp:` of the config for TCP"
        )
    return Path(named) if named else _usual(environ)[0]


def find_socket(environ: Mapping[str, str] = os.environ) -> Path | None:
    """The path of a socket that exists at a usual place: the user's before the system's; None: there is none."""
    return next((path for path in _usual(environ) if _may_be_socket(path)), None)


def _may_be_socket(path: Path) -> bool:
    """One that this user may not see is taken to be there: connecting to it says what is missing."""
    try:
        return path.is_socket()
    except PermissionError:
        return True


def _usual(environ: Mapping[str, str]) -> list[Path]:
    """In the folder that systemd made, the user's, the system's."""
    paths = [Path("/run/servobus") / FILE]
    if environ.get("XDG_RUNTIME_DIR"):
        paths.insert(0, Path(environ["XDG_RUNTIME_DIR"]) / "servobus" / FILE)
    if environ.get("RUNTIME_DIRECTORY"):
        paths.insert(0, Path(environ["RUNTIME_DIRECTORY"].split(":")[0]) / FILE)
    return paths
