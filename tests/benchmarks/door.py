"""A cached read through the daemon's door, beside a bare echo of JSON lines in the same run and the same regime."""

from __future__ import annotations

import asyncio
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from time import monotonic, perf_counter, sleep

import uvloop

from tests.benchmarks.regime import one_busy_core
from tests.benchmarks.report import Report, Row, Target
from tests.campaigns.daemon import READ, answer, daemon

ECHO = """
import asyncio, sys, msgspec
decode, encode = msgspec.json.decode, msgspec.json.encode
class Echo(asyncio.Protocol):
    def connection_made(self, transport): self.transport = transport
    def data_received(self, data):
        for line in data.splitlines(): self.transport.write(encode(decode(line)) + b"\\n")
async def main():
    server = await asyncio.get_running_loop().create_unix_server(Echo, sys.argv[1])
    await server.serve_forever()
try:
    import uvloop; uvloop.run(main())
except ImportError:
    asyncio.run(main())
"""
TRIPS = 4000
"""Reads of one round, one in flight."""
ROW = "cached read through the door"


class Reader(asyncio.Protocol):
    """A client with one request in flight."""

    def __init__(self) -> None:
        self.times: list[float] = []
        self.done = asyncio.get_running_loop().create_future()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport) or hasattr(transport, "write")
        self.transport = transport
        self._request()

    def _request(self) -> None:
        self._began = perf_counter()
        self.transport.write(READ)

    def data_received(self, data: bytes) -> None:
        if not data.endswith(b"\n"):
            return
        self.times.append(perf_counter() - self._began)
        if len(self.times) < TRIPS:
            self._request()
        elif not self.done.done():
            self.transport.close()
            self.done.set_result(None)


@contextmanager
def echo(path: str) -> Iterator[None]:
    """A process that echoes JSON lines on that socket."""
    process = subprocess.Popen([sys.executable, "-c", ECHO, path])
    try:
        while not Path(path).exists():
            sleep(0.01)
        yield
    finally:
        process.kill()
        process.wait()


def cpu(pid: int) -> float:
    """Seconds of CPU that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


async def _round_trip_us(path: str) -> float:
    """The median of one round."""
    _, reader = await asyncio.get_running_loop().create_unix_connection(Reader, path)
    await reader.done
    return statistics.median(reader.times) * 1e6


async def _measure(folder: Path, rounds: int) -> Mapping[str, Row]:
    echo_path, door_path = str(folder / "echo.sock"), str(folder / "s" / "servobus.sock")
    echoes, doors, used, idle = [], [], 0.0, 0.0
    with daemon(folder, "sim:") as process, echo(echo_path):
        assert await answer(folder, 10)
        for _ in range(rounds):
            echoes.append(await _round_trip_us(echo_path))
            before, began = cpu(process.pid), monotonic()
            doors.append(await _round_trip_us(door_path))
            used += cpu(process.pid) - before
            elapsed = monotonic() - began
            before = cpu(process.pid)
            await asyncio.sleep(elapsed)  # what the bus itself needs in the same time
            idle += cpu(process.pid) - before
    bare, door = statistics.median(echoes), statistics.median(doors)
    cpu_us = max(0.0, used - idle) / (rounds * TRIPS) * 1e6
    return {
        "echo of JSON lines": {"p50 us": bare, "of the echo": 1.0, "CPU us of the daemon": None},
        ROW: {"p50 us": door, "of the echo": door / bare, "CPU us of the daemon": cpu_us},
    }


def main(_: float, rounds: int) -> Report:
    factory = uvloop.new_event_loop
    with one_busy_core(), tempfile.TemporaryDirectory() as folder, asyncio.Runner(loop_factory=factory) as runner:
        rows = runner.run(_measure(Path(folder), rounds))
    targets = [Target(ROW, "of the echo", maximum=2.0), Target(ROW, "CPU us of the daemon", maximum=40.0)]
    return Report("one request in flight on a Unix socket", rows, targets)
