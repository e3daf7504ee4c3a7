"""How servobus logs: through the standard `logging` tree `servobus.*`, an event and its fields a line. It prints nothing.

A program that configures `logging` reads `line_down: bus=arm port=/dev/ttyUSB0`. A formatter that knows more (the daemon's) finds
the event and its fields apart, in the record's `servobus_event` and `servobus_fields`.
"""

from __future__ import annotations

import logging
from typing import Any

logging.getLogger("servobus").addHandler(logging.NullHandler())  # without it Python prints warnings on standard error


class EventLogger:
    """Logs events with fields: `log.info("running", config=path)`."""

    def __init__(self, name: str) -> None:
        self._logger = logging.getLogger(name)

    def info(self, event: str, **fields: Any) -> None:
        self._log(logging.INFO, event, fields)

    def warning(self, event: str, **fields: Any) -> None:
        self._log(logging.WARNING, event, fields)

    def error(self, event: str, **fields: Any) -> None:
        self._log(logging.ERROR, event, fields)

    def _log(self, level: int, event: str, fields: dict[str, Any]) -> None:
        if not self._logger.isEnabledFor(level):
            return
        text = " ".join(f"{key}={value}" for key, value in fields.items())
        extra = {"servobus_event": str(event), "servobus_fields": fields}
        self._logger.log(level, "%s", f"{event}: {text}" if text else event, extra=extra, stacklevel=3)
