"""The daemon as a process that is killed and started again and again."""

from __future__ import annotations

import asyncio
import json
import os
import random
import signal
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic

from servobus.config.loader import parse_config
from servobus.links.base import FarEnd
from servobus.simulation.link import far_end, simulated_line
from servobus.simulation.pty import SimulatedPty

RIG = """version: 1
door: {rate: null, clients: 5000, clients_per_user: 5000}
buses:
  arm:
    protocol: sms
    port: %s
    baudrate: 1000000
    poll: {feedback: 50}
    servos:
"""
SERVOS = "".join(f"      s{number}: {{id: {number}, model: sts}}\n" for number in range(1, 7))
READ = b'{"jsonrpc":"2.0","id":1,"method":"read","params":{"name":"arm/s1","max_age":1}}\n'
WRITES = frozenset({0x03, 0x04, 0x05, 0x83})
"""Instructions that write: no start may send one."""
BACK_WITHIN = 2.0


@dataclass(slots=True)
class Killed:
    """The figures of a daemon that was killed so often."""

    times: int = 0
    late: int = 0
    writes: int = 0
    seconds: list[float] = field(default_factory=list)

    def report(self) -> None:
        slowest = max(self.seconds, default=0.0)
        print(
            f"kill -9: {self.times} times, back within {statistics.median(self.seconds):.2f} s (p50), {slowest:.2f} s (max), "
            f"{self.late} later than {BACK_WITHIN:g} s, {self.writes} frames that write at start"
        )


@contextmanager
def daemon(folder: Path, port: str, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    path = folder / "rig.yaml"
    path.write_text(RIG % json.dumps(port) + SERVOS)
    process = start(folder)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def start(folder: Path) -> subprocess.Popen[bytes]:
    environ = {**os.environ, "SERVOBUS_SOCKET": str(folder / "s" / "servobus.sock")}
    command = [sys.executable, "-m", "servobus", "run", str(folder / "rig.yaml")]
    return subprocess.Popen(command, env=environ, stderr=subprocess.DEVNULL)


async def answer(folder: Path, within: float) -> bool:
    """Return whether a daemon answers a read of a servo in that time."""
    end = monotonic() + within
    while monotonic() < end:
        with suppress(OSError, ValueError, KeyError):
            reader, writer = await asyncio.open_unix_connection(str(folder / "s" / "servobus.sock"))
            try:
                writer.write(READ)
                async with asyncio.timeout(1):
                    message = json.loads(await reader.readline())
                if message["result"]["position"] is not None:
                    return True
            except TimeoutError:
                pass
            finally:
                writer.close()
        await asyncio.sleep(0.01)
    return False


def kills(times: int, seed: int = 1) -> Killed:
    with tempfile.TemporaryDirectory() as folder:
        return asyncio.run(_kills(Path(folder), times, random.Random(seed)))


class Watched:
    """A far end that counts the frames that write."""

    def __init__(self, inner: FarEnd, result: Killed) -> None:
        self._inner, self._result = inner, result
        self.attach, self.set_baudrate = inner.attach, inner.set_baudrate

    def receive(self, data: bytes) -> None:
        at = data.find(b"\xff\xff")
        self._result.writes += at >= 0 and len(data) > at + 4 and data[at + 4] in WRITES
        self._inner.receive(data)


async def _kills(folder: Path, times: int, rng: random.Random) -> Killed:
    """Kill and start a daemon again and again; its line is simulated in this process."""
    loop, result = asyncio.get_running_loop(), Killed()
    setup = parse_config(RIG % '"sim:"' + SERVOS, "campaign")
    options, models = setup.buses["arm"], setup.models["arm"]
    with closing(simulated_line(options, models, loop)) as line:
        watched = Watched(far_end(options, line, loop), result)
        with closing(SimulatedPty(watched, loop)) as pty, daemon(folder, pty.path) as process:
            current = process
            for _ in range(times):
                began = monotonic()
                back = await answer(folder, 10.0)
                result.seconds.append(monotonic() - began)
                result.late += not back or result.seconds[-1] > BACK_WITHIN
                await asyncio.sleep(rng.uniform(0, 0.1))
                current.send_signal(signal.SIGKILL)
                current.wait()
                result.times += 1
                current = start(folder)
            current.kill()
            current.wait()
    return result
