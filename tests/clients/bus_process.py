"""A simulated bus in a process of its own, for clients that block."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

CONFIG = """\
version: 1
buses:
  arm:
    protocol: sms
    port: "sim:"
    baudrate: 1000000
    servos:
      base: {id: 1, model: sts}
      elbow: {id: 2, model: sts, zero: 1000}
      wrist: {id: 3, model: sts, zero: 3000}
"""
"""The servos are at 2048, 1000 and 3000."""


@contextmanager
def served(folder: Path, config: str = CONFIG) -> Iterator[str]:
    """Yield the path of its port. At the end the process is interrupted, as by Ctrl-C."""
    file = folder / "sim.yaml"
    file.write_text(config)
    command = [sys.executable, "-m", "servobus", "sim", str(file)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            name, path = process.stdout.readline().split()
            assert name == "arm"
            yield path
        finally:
            process.send_signal(signal.SIGINT)
            rest = process.stdout.read()
    assert (rest, process.returncode) == ("", 130)
