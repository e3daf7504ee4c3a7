"""Where a bus at work tells things. A reader who has gone (`| head`, a closed terminal) must not stop a bus in mid-turn."""

from __future__ import annotations

import os
from contextlib import suppress
from typing import TextIO


class SafeStream:
    """A stream as logs and traces need it; what it says is lost in silence once nobody can hear it."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def say(self, line: str) -> None:
        self.write(f"{line}\n")
        self.flush()

    def write(self, text: str) -> None:
        try:
            self._stream.write(text)
        except OSError:
            self._hush()

    def flush(self) -> None:
        try:
            self._stream.flush()
        except OSError:
            self._hush()

    def _hush(self) -> None:
        """Everything further goes nowhere, also what the interpreter flushes at its end."""
        with suppress(OSError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)
