"""The e-stop's latch in a file, so that it survives a restart of the process that owns the ports."""

from __future__ import annotations

from pathlib import Path

from servobus.rig.logs import EventLogger

log = EventLogger("servobus.rig")


class LatchFile:
    """A file that exists while the e-stop is latched. An error of the file system is logged, and never hinders a stop."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def latched(self) -> bool:
        """Whether the e-stop was latched when the last process ended."""
        return self._path.exists()

    def set(self, *, latched: bool) -> None:
        """Keep the state of the latch."""
        try:
            if latched:
                self._path.touch(mode=0o600)
            else:
                self._path.unlink(missing_ok=True)
        except OSError as error:
            reason = f"{error.strerror}: the e-stop is {'latched' if latched else 'released'} in this process alone"
            log.error("latch_not_kept", path=str(self._path), reason=reason)
