"""The rules about joints through a daemon: real processes on a PTY, whose other end is a witness line in this process."""

from __future__ import annotations

import asyncio
import random
import signal
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager

from tests.campaigns.bench import Bench, Case, Figures
from tests.campaigns.commands import Shell, end_of, shell
from tests.campaigns.scenarios_goals import sms
from tests.campaigns.scenarios_stops import set_off

SOCKET = "FOLDER/run/servobus.sock"
CLIENT = """
import asyncio, sys, servobus
async def main():
    async with servobus.connect() as rig:
        await rig.enable("s1")
        print("ready", flush=True)
        await asyncio.get_running_loop().run_in_executor(None, sys.stdin.readline)
        print(await rig["s1"].move_to(30))
asyncio.run(main())
"""
"""A program that is connected before the daemon stands still, and sends its goal while it does."""
STOOD_STILL = 1.0
"""Seconds for which a daemon is stopped: five times as long as a goal may wait."""


@asynccontextmanager
async def daemon(bench: Bench) -> AsyncIterator[tuple[Shell, asyncio.subprocess.Process]]:
    """A daemon that serves the bench, and commands that reach it."""
    with shell(bench, SERVOBUS_SOCKET=SOCKET) as commands:
        process = await commands.start("run", "servobus.yaml")
        try:
            for _ in range(100):
                if (await commands.run("read", "s1")).status == 0:
                    break
            yield commands, process
        finally:
            if process.returncode is None:
                process.kill()
            await end_of(process)


async def stop_through_it(case: Case, rng: random.Random, figures: Figures) -> None:
    """`servobus stop` through a daemon stops what another program has left moving."""
    bench = Bench(case, rng, 2)
    async with daemon(bench) as (commands, _):
        set_off(sms(bench.servos[0]), bench.line.clock())
        ended = await commands.run("stop")
        figures.broken += [f"status {ended.status}: {ended.text[:200]}"] if ended.status else []
        figures.false_stops += await bench.travels_within(0.3) > 0


async def ended_by_signal(case: Case, rng: random.Random, figures: Figures) -> None:
    """A daemon that SIGTERM ends holds what moves; one that is killed writes nothing when it starts again."""
    bench = Bench(case, rng, 2)
    async with daemon(bench) as (commands, process):
        await commands.run("enable", "s1", "s2")
        moving = await commands.start("move", "s1=60", "--speed", "10")
        await _until_it_moves(bench)
        process.send_signal(signal.SIGTERM)
        await end_of(process)
        figures.travel += await bench.travels_within(0.5)
        await end_of(moving)


async def stood_still(case: Case, rng: random.Random, figures: Figures) -> None:
    """Goals that waited for a daemon that stood still are not sent when it goes on."""
    bench = Bench(case, rng, 2)
    async with daemon(bench) as (commands, process):
        client = await commands.python(CLIENT)
        assert client.stdin is not None
        assert client.stdout is not None
        await client.stdout.readline()
        process.send_signal(signal.SIGSTOP)
        client.stdin.write(b"go\n")
        await asyncio.sleep(STOOD_STILL + rng.uniform(0.5, 1.5))
        bench.mark()
        process.send_signal(signal.SIGCONT)
        ended = await end_of(client)
        figures.broken += [f"status {ended.status}: {ended.text[:200]}"] if not ended.status else []
        await asyncio.sleep(0.3)
        figures.travel += bench.travel()


async def lost_client(case: Case, rng: random.Random, figures: Figures) -> None:
    """A client that is killed while its servo moves: the servo is held."""
    bench = Bench(case, rng, 2)
    async with daemon(bench) as (commands, _):
        await commands.run("enable", "s1")
        moving = await commands.start("move", "s1=60", "--speed", "10")
        await _until_it_moves(bench)
        moving.kill()
        await end_of(moving)
        await asyncio.sleep(2.0)  # a lease ends a moment later
        figures.owed += await bench.travels_within(0.5) > 0


async def _until_it_moves(bench: Bench) -> None:
    for _ in range(1000):
        bench.line.settle()
        if sms(bench.servos[0]).moves():
            return
        await asyncio.sleep(0.01)
    raise AssertionError("it never moved")


STS, MODES = [Case("sms", "sts")], [Case("sms", "sts", mode) for mode in ("position", "velocity", "pwm", "step")]
Scenario = Callable[[Case, random.Random, Figures], Awaitable[None]]
RULES: list[tuple[str, Scenario, list[Case], int]] = [
    ("2 servobus stop through a daemon", stop_through_it, MODES, 4),
    ("b a client of a daemon is killed", lost_client, STS, 3),
    ("f a daemon that stood still", stood_still, STS, 3),
    ("g a daemon that is ended", ended_by_signal, STS, 3),
]
