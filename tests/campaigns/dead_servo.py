"""A line in real time over a PTY: measures the cost of a dead servo to its neighbours, and how soon an unplugged port is noticed.

The simulated line and the rig share one process and one loop, so the CPU figure counts both.
"""

from __future__ import annotations

import asyncio
import tempfile
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path

from servobus.config.loader import Config, parse_config
from servobus.errors import LinkDown, ServobusError
from servobus.rig.local import LocalRig, open_rig
from servobus.simulation.line import SimulatedLine
from servobus.simulation.link import simulated_line
from servobus.simulation.pty import SimulatedPty

SERVOS = 10
BAUDRATE = 1_000_000


@dataclass(slots=True)
class Figures:
    """Times in seconds, rates in reads per second of the nine servos that stay alive."""

    rate_before: float = 0.0
    rate_with_dead: float = 0.0
    unplug: float = 0.0
    """Until the last of the awaits in flight had failed."""
    unplug_errors: int = 0
    replug: float = 0.0
    """Until the first value."""
    cpu: float = 0.0
    """Share of one core while the plug was out."""

    def report(self) -> None:
        print(
            f"ten servos, one dead: {self.rate_with_dead / self.rate_before:.0%} of the others' rate "
            f"({self.rate_before:.0f} -> {self.rate_with_dead:.0f} reads/s)"
        )
        print(f"unplug: {self.unplug_errors} awaits in flight failed within {1e3 * self.unplug:.1f} ms")
        print(f"while unplugged: {self.cpu:.2%} of a core")
        print(f"replug: first value after {1e3 * self.replug:.0f} ms")


def config(port: Path) -> Config:
    servos = "".join(f"      s{number}: {{id: {number}, model: sts}}\n" for number in range(1, SERVOS + 1))
    text = f"version: 1\nbuses:\n  arm:\n    protocol: sms\n    port: {port}\n    baudrate: {BAUDRATE}\n    servos:\n{servos}"
    return parse_config(text, "line campaign", Path())


def main(seconds: float = 2.0) -> Figures:
    """Run it and print the figures."""
    figures = asyncio.run(_campaign(seconds))
    figures.report()
    return figures


async def _campaign(seconds: float) -> Figures:
    figures = Figures()
    loop = asyncio.get_running_loop()
    with tempfile.TemporaryDirectory() as folder:
        port = Path(folder) / "port"
        setup = config(port)
        line = simulated_line(setup.buses["arm"], setup.models["arm"], loop)
        pty = SimulatedPty(line, loop, symlink=port)
        try:
            async with open_rig(setup) as rig:
                figures.rate_before = await _rate(rig, seconds)
                await _dead_servo(rig, line, figures, seconds)
                figures.unplug, figures.unplug_errors = await _unplug(rig, pty)
                used = time.process_time()
                await asyncio.sleep(seconds)
                figures.cpu = (time.process_time() - used) / seconds
                pty = SimulatedPty(line, loop, symlink=port)
                figures.replug = await _until(lambda: rig.read("s2"))
        finally:
            pty.close()
            line.close()
    return figures


async def _rate(rig: LocalRig, seconds: float) -> float:
    """Reads per second of all servos but the first."""

    async def caller(name: str) -> int:
        count, end = 0, time.monotonic() + seconds
        while time.monotonic() < end:
            await rig.read_register(name, "present_position")
            count += 1
        return count

    return sum(await asyncio.gather(*(caller(f"s{number}") for number in range(2, SERVOS + 1)))) / seconds


async def _dead_servo(rig: LocalRig, line: SimulatedLine, figures: Figures, seconds: float) -> None:
    """Measure the rate while callers go on asking the dead servo."""

    async def ask_the_dead() -> None:
        while True:
            try:
                await rig.read_register("s1", "present_position")
            except ServobusError:
                await asyncio.sleep(0)

    line.devices[0].dead = True  # type: ignore[attr-defined]
    asking = asyncio.create_task(ask_the_dead())
    try:
        figures.rate_with_dead = await _rate(rig, seconds)
    finally:
        asking.cancel()
        line.devices[0].dead = False  # type: ignore[attr-defined]


async def _unplug(rig: LocalRig, pty: SimulatedPty) -> tuple[float, int]:
    asked = [asyncio.create_task(rig.read(f"s{number}")) for number in range(2, SERVOS + 1)]
    await asyncio.sleep(0)
    began = time.monotonic()
    pty.close()
    results = await asyncio.gather(*asked, return_exceptions=True)
    return time.monotonic() - began, sum(isinstance(result, LinkDown) for result in results)


async def _until(attempt: Callable[[], Awaitable[object]]) -> float:
    began = time.monotonic()
    while True:
        try:
            await attempt()
            return time.monotonic() - began
        except ServobusError:
            await asyncio.sleep(0.001)
