"""The stream of logs and traces. A reader who is gone (`| head`, a closed terminal) must not stop a bus in mid-turn."""

from __future__ import annotations

import os
from contextlib import suppress
from typing import TextIO


class SafeStream:
    """Writes to a stream, and discards everything once nobody reads it."""

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
