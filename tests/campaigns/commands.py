"""The rules about joints from the command line: real processes on a PTY, whose other end is a witness line in this process."""

from __future__ import annotations

import asyncio
import os
import random
import signal
import sys
from collections.abc import Awaitable, Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from servobus.simulation.pty import SimulatedPty
from tests.campaigns.bench import Bench, Case, Figures
from tests.campaigns.scenarios_goals import sms
from tests.campaigns.scenarios_stops import set_off
from tests.campaigns.witness_sms import MAX_LIMIT, MIN_LIMIT, REG_WRITE, TORQUE

PORT = '"witness://line"'


@dataclass(frozen=True, slots=True)
class Ended:
    """How a command ended."""

    status: int
    text: str


class Shell:
    """Runs commands in a folder whose `servobus.yaml` is the config of the bench."""

    def __init__(self, bench: Bench, folder: Path, **environ: str) -> None:
        self.bench = bench
        self.folder = folder
        self.environ = {**os.environ, "XDG_RUNTIME_DIR": str(folder), **environ}

    async def start(self, *arguments: str) -> asyncio.subprocess.Process:
        return await self._start("-m", "servobus", *arguments)

    async def python(self, text: str) -> asyncio.subprocess.Process:
        """Run a program of these lines."""
        return await self._start("-c", text)

    async def _start(self, *arguments: str) -> asyncio.subprocess.Process:
        pipe = asyncio.subprocess.PIPE
        return await asyncio.create_subprocess_exec(
            sys.executable, *arguments, cwd=self.folder, env=self.environ, stdin=pipe, stdout=pipe, stderr=pipe
        )

    async def run(self, *arguments: str) -> Ended:
        return await end_of(await self.start(*arguments))


async def end_of(process: asyncio.subprocess.Process) -> Ended:
    async with asyncio.timeout(60):
        output, errors = await process.communicate()
    assert process.returncode is not None
    return Ended(process.returncode, output.decode() + errors.decode())


@contextmanager
def shell(bench: Bench, *servo_keys: str, **environ: str) -> Iterator[Shell]:
    """A folder with a config, and a PTY behind which the bench is."""
    with (
        TemporaryDirectory() as folder,
        closing(bench.line),
        closing(SimulatedPty(bench.line, asyncio.get_running_loop())) as pty,
    ):
        text = bench.text(servo_keys).replace(PORT, pty.path)
        Path(folder, "servobus.yaml").write_text(text)
        environ.setdefault("SERVOBUS_SOCKET", "")
        yield Shell(bench, Path(folder), **{name: value.replace("FOLDER", folder) for name, value in environ.items()})


async def wrong_rig(case: Case, rng: random.Random, figures: Figures) -> None:
    """Where a daemon was named that does not answer, no command opens a port of its own."""
    bench = Bench(case, rng, 2)
    address = rng.choice(["tcp://127.0.0.1:1", "FOLDER/servobus.sock"])
    with shell(bench, SERVOBUS_SOCKET=address) as commands:
        verb = rng.choice([("move", "s1=20"), ("enable", "s1"), ("spin", "s1=20"), ("disable", "s1"), ("stop",)])
        ended = await commands.run(*verb)
        if ended.status != 1 or bench.line.log:
            figures.broken.append(f"{verb[0]} at {address}: status {ended.status}, {len(bench.line.log)} frames")
        figures.travel += bench.travel()


async def refused_move(case: Case, rng: random.Random, figures: Figures) -> None:
    """A move that is refused leaves nothing energised: another mode, outside the stored limits."""
    bench = Bench(case, rng, 2)
    servo = sms(bench.servos[0])
    if case.mode == "position":
        servo.put(MIN_LIMIT, 100)
        servo.put(MAX_LIMIT, 200)
    with shell(bench) as commands:
        ended = await commands.run("move", "s1=20", "s2=20")
        if ended.status == 0:
            figures.broken.append("the move was not refused")
        figures.energised += sum(len(each.energised_at) for each in bench.servos)
        figures.travel += bench.travel()


async def dead_partner(case: Case, rng: random.Random, figures: Figures) -> None:
    """A move with a dead partner says what it leaves energised, or leaves nothing so."""
    bench = Bench(case, rng, 2)
    bench.servos[1].deaf_until = 1e12
    with shell(bench) as commands:
        ended = await commands.run("move", "s1=20", "s2=20")
        left = bool(sms(bench.servos[0]).memory[TORQUE])
        if ended.status != 1 or (left and "s1" not in ended.text):
            figures.broken.append(f"status {ended.status}, torque {left}: {ended.text[:200]}")
        await _rest(bench, figures)


async def interrupted(case: Case, rng: random.Random, figures: Figures) -> None:
    """Ctrl-C, once or twice, ends the motion or says what it leaves energised."""
    bench = Bench(case, rng, 1)
    with shell(bench) as commands:
        process = await commands.start("move", "s1=60", "--speed", "10")
        await _until_it_moves(bench)
        twice = rng.random() < 0.5
        process.send_signal(signal.SIGINT)
        if twice:
            await asyncio.sleep(0.01)
            process.send_signal(signal.SIGINT)
        ended = await end_of(process)
        bench.line.settle()
        moves = sms(bench.servos[0]).moves()
        if ended.status not in (130, -signal.SIGINT) or "s1" not in ended.text or (moves and not twice):  # a shell shows 130
            figures.broken.append(f"status {ended.status}, twice {twice}, moves {moves}: {ended.text[:200]}")


async def stop_command(case: Case, rng: random.Random, figures: Figures) -> None:
    """`servobus stop` stops a servo by the rule of the mode it is in."""
    bench = Bench(case, rng, 2)
    with shell(bench) as commands:
        set_off(sms(bench.servos[0]), bench.line.clock())
        ended = await commands.run("stop")
        bench.line.settle()
        figures.false_stops += ended.status == 0 and sms(bench.servos[0]).moves()
        if ended.status:
            figures.broken.append(f"status {ended.status}: {ended.text[:200]}")
        await _rest(bench, figures)


async def killed(case: Case, rng: random.Random, figures: Figures) -> None:
    """A process that is killed between REG WRITE and ACTION leaves nothing that the next one fires."""
    bench = Bench(case, rng, 4)
    last = rng.randrange(1, 5)
    receive = bench.line.receive
    with shell(bench) as commands:
        first = await commands.start("move", *(f"s{number}=40" for number in range(1, 5)), "--together", "--confirm")

        def watch(data: bytes) -> None:
            receive(data)
            if data[2:3] == bytes((last,)) and data[4:5] == bytes((REG_WRITE,)):
                first.kill()

        bench.line.receive = watch  # type: ignore[method-assign]
        await end_of(first)
        bench.line.receive = receive  # type: ignore[method-assign]
        armed = [number for number in range(1, 5) if sms(bench.servos[number - 1]).armed]
        if not armed:
            figures.broken.append("it was killed too late to leave anything")
        bench.mark()
        before = [sms(servo).fired for servo in bench.servos]
        await commands.run("move", "s1=5", "s2=5", "--together", "--confirm")
        figures.fired += sum(sms(bench.servos[number - 1]).fired - before[number - 1] for number in (3, 4))
        figures.travel += bench.travel(3, 4)


async def _until_it_moves(bench: Bench) -> None:
    for _ in range(1000):
        if sms(bench.servos[0]).moves():
            return
        await asyncio.sleep(0.01)
    raise AssertionError("it never moved")


async def _rest(bench: Bench, figures: Figures) -> None:
    bench.mark()
    await asyncio.sleep(0.3)
    figures.travel += bench.travel()


STS = [Case("sms", "sts", mode) for mode in ("position", "velocity", "pwm", "step")]
Scenario = Callable[[Case, random.Random, Figures], Awaitable[None]]
RULES: list[tuple[str, Scenario, list[Case], int]] = [
    ("2 servobus stop, by the rule of the mode", stop_command, [*STS, Case("sms", "scs", "motor")], 10),
    ("a killed between REG WRITE and ACTION, -9", killed, [Case("sms", "sts"), Case("sms", "scs")], 20),
    ("7 the daemon that was named is not there", wrong_rig, [Case("sms", "sts")], 10),
    ("8 servobus move that is refused", refused_move, STS, 8),
    ("8 servobus move with a dead partner", dead_partner, [Case("sms", "sts")], 4),
    ("8 Ctrl-C, once or twice", interrupted, [Case("sms", "sts")], 8),
]
