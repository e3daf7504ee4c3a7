"""A thousand clients of one daemon read, subscribe, move and stop, while its bus keeps its rate."""

from __future__ import annotations

import asyncio
import json
import random
import resource
import statistics
import tempfile
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic
from typing import Any

from servobus.cli.event_loop import loop_factory
from tests.campaigns.daemon import answer, daemon

CLIENTS, RATE, HZ, MOVERS = 1000, 3.0, 5.0, 6
FILES = 4096
STOPPED = ("EStopped", "NotEnabled", "Busy")
"""Errors that a mover gets while the e-stop is latched or not finished."""


@dataclass(slots=True)
class Crowd:
    """What the campaign counted."""

    clients: int = 0
    asked: int = 0
    answered: int = 0
    errors: Counter[str] = field(default_factory=Counter)
    snapshots: int = 0
    goals: int = 0
    seconds: float = 0.0
    stops: list[float] = field(default_factory=list)
    before: float = 0.0
    during: float = 0.0
    memory: tuple[int, int] = (0, 0)

    def kept(self) -> bool:
        return self.during >= 0.9 * self.before and self.p99 <= 0.020 and not self.errors and self.memory[1] < 2 * self.memory[0]

    @property
    def p99(self) -> float:
        return sorted(self.stops)[int(0.99 * (len(self.stops) - 1))]

    def report(self) -> None:
        print(
            f"{self.clients} clients for {self.seconds:.0f} s: {self.answered / self.seconds:.0f} answers/s, "
            f"{self.snapshots / self.seconds:.0f} snapshots/s, {self.goals} goals, errors {dict(self.errors)}, "
            f"{self.asked - self.answered} unanswered"
        )
        share = 100 * self.during / self.before
        print(f"bus: {self.during:.0f} states polled/s among them, {self.before:.0f} before ({share:.0f} %)")
        print(
            f"e-stop, asked to confirmed: p50 {1e3 * statistics.median(self.stops):.1f} ms, p99 {1e3 * self.p99:.1f} ms "
            f"of {len(self.stops)}; memory {self.memory[0]} to {self.memory[1]} MB"
        )


class Member(asyncio.Protocol):
    """One client: counts its notices and the answers to its calls."""

    def __init__(self, crowd: Crowd) -> None:
        self._crowd = crowd
        self._rest = b""
        self._waiting: dict[int, asyncio.Future[Any]] = {}
        self._number = 0

    def connection_made(self, transport: Any) -> None:
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            if line.startswith(b'{"jsonrpc":"2.0","method"'):
                self._crowd.snapshots += 1
                continue
            message = json.loads(line)
            self._crowd.answered += 1
            kind = message.get("error", {}).get("data", {}).get("type", "other") if "error" in message else ""
            if kind and kind not in STOPPED:
                self._crowd.errors[kind] += 1
            future = self._waiting.pop(message["id"], None)
            if future is not None:
                future.set_result(message)

    def ask(self, method: str, **params: Any) -> int:
        self._number += 1
        self._crowd.asked += 1
        call = {"jsonrpc": "2.0", "id": self._number, "method": method, "params": params}
        self._transport.write(json.dumps(call).encode() + b"\n")
        return self._number

    async def call(self, method: str, **params: Any) -> Any:
        future = asyncio.get_running_loop().create_future()
        self._waiting[self.ask(method, **params)] = future
        return await future


def rss(pid: int) -> int:
    """Return the resident memory in MB."""
    line = next(line for line in Path(f"/proc/{pid}/status").read_text().splitlines() if line.startswith("VmRSS"))
    return int(line.split()[1]) // 1024


async def _join(crowd: Crowd, path: str) -> Member:
    while True:
        try:
            return (await asyncio.get_running_loop().create_unix_connection(lambda: Member(crowd), path))[1]
        except BlockingIOError:  # as many wait to be let in as may wait
            await asyncio.sleep(0.01)


async def _polled(member: Member) -> int:
    stats = (await member.call("stats"))["result"]
    return int(stats["arm"]["polled"])


async def _rate(member: Member, seconds: float) -> float:
    first, began = await _polled(member), monotonic()
    await asyncio.sleep(seconds)
    return (await _polled(member) - first) / (monotonic() - began)


async def _member(member: Member, number: int, until: float) -> None:
    rng = random.Random(number)
    await member.call("subscribe", topic="state", hz=HZ, names=["s1"])
    await asyncio.sleep(rng.uniform(0, 1 / RATE))
    while monotonic() < until:
        if number < MOVERS:
            member._crowd.goals += 1
            await member.call("acquire", names=[f"s{number + 1}"])
            member.ask("move_to", name=f"s{number + 1}", position=rng.uniform(-30, 30))
        else:
            member.ask("read", name=f"s{rng.randrange(1, 7)}", max_age=1)
        await asyncio.sleep(1 / RATE)


async def _stopper(member: Member, movers: list[Member], crowd: Crowd, until: float) -> None:
    while monotonic() < until:
        await asyncio.sleep(0.25)
        began = monotonic()
        await member.call("stop")
        crowd.stops.append(monotonic() - began)
        await member.call("clear")
        await asyncio.gather(*(servo.call("enable", names=[f"s{number + 1}"]) for number, servo in enumerate(movers)))


async def _run(folder: Path, seconds: float, clients: int) -> Crowd:
    crowd, loop = Crowd(clients=clients), asyncio.get_running_loop()
    with daemon(folder, "sim:") as process:
        assert await answer(folder, 10)
        path = str(folder / "s" / "servobus.sock")
        members = [await _join(crowd, path) for _ in range(clients)]
        chief = await _join(crowd, path)
        await chief.call("enable")
        crowd.before = await _rate(chief, 3)
        began, until = monotonic(), monotonic() + seconds
        tasks = [loop.create_task(_member(member, number, until)) for number, member in enumerate(members)]
        await asyncio.sleep(2)
        start = rss(process.pid)
        stopping = loop.create_task(_stopper(chief, members[:MOVERS], crowd, until))
        crowd.during = await _rate(await _join(crowd, path), seconds - 3)
        await asyncio.gather(stopping, *tasks)
        crowd.seconds = monotonic() - began
        crowd.memory = start, rss(process.pid)
        await asyncio.sleep(1)
    return crowd


def crowd(seconds: float = 60.0, clients: int = CLIENTS) -> Crowd:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, min(FILES, hard)), hard))  # the daemon inherits it
    with tempfile.TemporaryDirectory() as folder, asyncio.Runner(loop_factory=loop_factory()) as runner:
        return runner.run(_run(Path(folder), seconds, clients))
