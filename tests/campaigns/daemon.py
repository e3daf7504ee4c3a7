"""The daemon as a process: killed and started again and again; and how long its door takes beside a bare echo.

The echo is taken in the same run and the same regime: one core is kept busy, and everything measured shares the other.
"""

from __future__ import annotations

import asyncio
import json
import multiprocessing
import os
import random
import signal
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic, perf_counter, sleep

from servobus.cli.output import loop_factory
from tests.campaigns.turns_bench import spin

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
"""Instructions that write: none may be said at start."""
BACK_WITHIN = 2.0


@dataclass(slots=True)
class Killed:
    """What became of a daemon that was killed so often."""

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
    """Somebody answers a read of a servo that was asked on the line."""
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


async def _kills(folder: Path, times: int, rng: random.Random) -> Killed:
    """On a simulated line of a process of its own, which sees what is written at each start."""
    from servobus.config.loader import parse_config
    from servobus.links.base import FarEnd
    from servobus.simulation.link import far_end, simulated_line
    from servobus.simulation.pty import SimulatedPty

    loop, result = asyncio.get_running_loop(), Killed()
    setup = parse_config(RIG % '"sim:"' + SERVOS, "campaign")
    options, models = setup.buses["arm"], setup.models["arm"]
    line = simulated_line(options, models, loop)
    inner: FarEnd = far_end(options, line, loop)
    heard = inner.receive

    def receive(data: bytes) -> None:
        at = data.find(b"\xff\xff")
        result.writes += at >= 0 and len(data) > at + 4 and data[at + 4] in WRITES
        heard(data)

    inner.receive = receive  # type: ignore[method-assign]
    pty = SimulatedPty(inner, loop)
    try:
        with daemon(folder, pty.path) as process:
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
    finally:
        pty.close()
        line.close()
    return result


# The door beside an echo


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
ROUNDS, TRIPS = 5, 4000


class Asker(asyncio.Protocol):
    """One question in flight."""

    def __init__(self) -> None:
        self.times: list[float] = []
        self.done = asyncio.get_running_loop().create_future()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport) or hasattr(transport, "write")
        self.transport = transport
        self._ask()

    def _ask(self) -> None:
        self._asked = perf_counter()
        self.transport.write(READ)

    def data_received(self, data: bytes) -> None:
        if not data.endswith(b"\n"):
            return
        self.times.append(perf_counter() - self._asked)
        if len(self.times) < TRIPS:
            self._ask()
        elif not self.done.done():
            self.transport.close()
            self.done.set_result(None)


def echoing(path: str) -> subprocess.Popen[bytes]:
    """A process that echoes there; returns when it does."""
    process = subprocess.Popen([sys.executable, "-c", ECHO, path])
    while not Path(path).exists():
        sleep(0.01)
    return process


def cpu(pid: int) -> float:
    """Seconds of CPU that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


async def _trips(path: str) -> float:
    """Microseconds, p50."""
    _, asker = await asyncio.get_running_loop().create_unix_connection(Asker, path)
    await asker.done
    return statistics.median(asker.times) * 1e6


async def _door(folder: Path) -> tuple[float, float]:
    echo_path, door_path = str(folder / "echo.sock"), str(folder / "s" / "servobus.sock")
    with daemon(folder, "sim:") as process:
        echo = echoing(echo_path)
        try:
            assert await answer(folder, 10)
            echoes, doors, used, idle = [], [], 0.0, 0.0
            for _ in range(ROUNDS):
                echoes.append(await _trips(echo_path))
                before, at = cpu(process.pid), monotonic()
                doors.append(await _trips(door_path))
                used += cpu(process.pid) - before
                took = monotonic() - at
                before = cpu(process.pid)
                await asyncio.sleep(took)  # what the bus itself needs meanwhile
                idle += cpu(process.pid) - before
        finally:
            echo.kill()
            echo.wait()
    ratio = statistics.median(doors) / statistics.median(echoes)
    each = max(0.0, used - idle) / (ROUNDS * TRIPS) * 1e6
    print(f"cached read through the door: p50 {statistics.median(doors):.0f} us, {ratio:.2f} of a bare echo of JSON lines")
    print(f"CPU of the daemon: {each:.0f} us a request")
    return ratio, each


def door() -> tuple[float, float]:
    cores = os.sched_getaffinity(0)
    spinner = multiprocessing.get_context("fork").Process(target=spin, daemon=True)
    spinner.start()
    try:
        os.sched_setaffinity(0, {min(cores)})  # the processes begun from here inherit it
        with tempfile.TemporaryDirectory() as folder, asyncio.Runner(loop_factory=loop_factory()) as runner:
            return runner.run(_door(Path(folder)))
    finally:
        os.sched_setaffinity(0, cores)
        spinner.kill()
        spinner.join()
