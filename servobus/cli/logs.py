"""The logs of a command: the `servobus` tree of `logging`, formatted by structlog, on standard error."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import MutableMapping
from contextlib import suppress
from functools import cached_property
from typing import Any, TextIO, cast


def set_up_logs(level: int = logging.WARNING) -> None:
    """Log to standard error: for people on a terminal, one JSON document a line otherwise."""
    handler = logging.StreamHandler(cast("TextIO", SafeStream(sys.stderr)))
    handler.setFormatter(StructlogFormatter())
    logger = logging.getLogger("servobus")
    logger.handlers, logger.propagate = [handler], False
    logger.setLevel(level)


class StructlogFormatter(logging.Formatter):
    """Formats by structlog, which is imported with the first record: most commands log nothing."""

    def format(self, record: logging.LogRecord) -> str:
        return self._formatter.format(record)

    @cached_property
    def _formatter(self) -> logging.Formatter:
        import structlog

        renderer: Any = structlog.processors.JSONRenderer()
        if sys.stderr.isatty():
            renderer = structlog.dev.ConsoleRenderer(colors=not os.environ.get("NO_COLOR"))
        return structlog.stdlib.ProcessorFormatter(
            processors=[
                _event_and_fields,
                structlog.processors.add_log_level,
                structlog.processors.TimeStamper(fmt="iso", utc=True),
                structlog.stdlib.ProcessorFormatter.remove_processors_meta,
                renderer,
            ]
        )


def _event_and_fields(_: Any, __: str, event: MutableMapping[str, Any]) -> MutableMapping[str, Any]:
    """Takes the event and its fields as `servobus.rig.logs` puts them into a record."""
    record = event["_record"]
    fields = getattr(record, "servobus_fields", {})
    return {**fields, **event, "event": getattr(record, "servobus_event", event["event"])}


class SafeStream:
    """Discards everything once nobody reads the stream: a closed terminal or pipe must not stop a bus in mid-turn."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write_line(self, line: str) -> None:
        self.write(f"{line}\n")
        self.flush()

    def write(self, text: str) -> None:
        try:
            self._stream.write(text)
        except OSError:
            self._discard()

    def flush(self) -> None:
        try:
            self._stream.flush()
        except OSError:
            self._discard()

    def _discard(self) -> None:
        """Sends everything further to /dev/null, also what the interpreter flushes when it ends."""
        with suppress(OSError):
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, self._stream.fileno())
            os.close(null)
