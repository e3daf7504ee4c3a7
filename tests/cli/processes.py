"""Runs commands as processes, also on a terminal."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import termios
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import IO

from tests.config.mistakes import GOOD

LIMP = GOOD.replace("id: 1,", "id: 1, on_exit: limp,")


@contextmanager
def servobus(
    *arguments: str, stdout: int | IO[bytes] = subprocess.PIPE, stderr: int | IO[bytes] = subprocess.PIPE, **environment: str
) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        [sys.executable, "-m", "servobus", *arguments],
        stdout=stdout,
        stderr=stderr,
        text=True,
        env={**os.environ, **environment},
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


class Terminal:
    """A pseudo-terminal of 80 columns. The program writes to `end`, and the test reads."""

    def __init__(self) -> None:
        ours, theirs = os.openpty()
        self._ours, self.end = os.fdopen(ours, "rb", buffering=0), os.fdopen(theirs, "wb", buffering=0)
        termios.tcsetwinsize(self.end, (24, 80))

    def some(self) -> str:
        return (self._ours.read(65536) or b"").decode()

    def rest(self) -> str:
        """Returns everything that is written until all writers have ended."""
        self.end.close()
        output = ""
        with suppress(OSError):  # how Linux says that no writer is left
            while piece := self.some():
                output += piece
        return output

    def close(self) -> None:
        self.end.close()
        self._ours.close()


def until(process: subprocess.Popen[str], event: str) -> dict[str, object]:
    """Returns the first log record of this event."""
    assert process.stderr is not None
    for line in process.stderr:
        record: dict[str, object] = json.loads(line)
        if record["event"] == event:
            return record
    raise AssertionError(f"{event} was never logged")
