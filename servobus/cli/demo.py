"""The main job, shown on embedded simulated lines: one caller per servo streams goals while feedback is polled."""

from __future__ import annotations

import asyncio
import logging
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import click

from servobus.cli.offline import loads_of
from servobus.cli.output import Number, echo_table, emit, logs, run
from servobus.config.loader import parse_config
from servobus.errors import ServobusError
from servobus.rig.interface import Servo
from servobus.rig.local import LocalRig, open_rig
from servobus.values import Outcome

GOAL_HZ = 100.0
FEEDBACK_HZ = 50.0
FINGERS = ("thumb_bend", "index", "middle", "ring", "little", "thumb_rotation")
PERIOD = 4.0
"""Seconds of one swing."""


@dataclass(frozen=True)
class Line:
    """A bus of the demo; its servos swing about `middle`, in their unit."""

    protocol: str
    baudrate: int
    servos: Sequence[str]
    middle: float = 0.0
    swing: float = 30.0


LINES = {
    "arm": Line("sms", 1_000_000, [f"sts{number}: {{id: {number}, model: sts, max_speed: 300}}" for number in range(1, 7)]),
    "base": Line("sms", 115_200, [f"sms{number}: {{id: {number}, model: sms, max_speed: 300}}" for number in range(1, 5)]),
    "gimbal": Line("kst", 512_000, [f"kst{number}: {{id: {number}, max_speed: 300}}" for number in range(1, 5)]),
    "hand": Line("roh", 115_200, [f"{channel}: {{id: 2, channel: {channel}}}" for channel in FINGERS], middle=50, swing=40),
}


def config_text() -> str:
    """The simulated rig."""
    text = "version: 1\nbuses:\n"
    for bus, line in LINES.items():
        text += f"  {bus}:\n    protocol: {line.protocol}\n    port: 'sim:'\n    baudrate: {line.baudrate}\n"
        text += f"    poll: {{feedback: {FEEDBACK_HZ:g}}}\n    goal_rate: {GOAL_HZ:g}\n    servos:\n"
        text += "".join(f"      {servo}\n" for servo in line.servos)
    return text


@dataclass(slots=True)
class Tally:
    """What the callers of one bus saw."""

    outcomes: Counter[str] = field(default_factory=Counter)
    errors: Counter[str] = field(default_factory=Counter)


@click.command()
@click.option("--seconds", default=10.0, show_default=True, type=Number(0.5, 3600), help="How long to stream.")
@click.option("--json", "as_json", is_flag=True, help="For machines.")
def demo(seconds: float, as_json: bool) -> int:
    """Stream goals to 20 simulated servos on four lines with real wire time, and print what the lines carried.

    Six STS at 1 Mbaud, four SMS at 115200 baud, four KST at 512000 and the six fingers of a ROH hand at 115200; one caller per
    servo sends 100 goals a second, feedback is polled at 50 Hz.

    Example: servobus demo --seconds 3
    """
    logs(logging.ERROR)
    config = parse_config(config_text(), "demo")
    if not as_json:
        for name, load in loads_of(config).items():
            options = config.buses[name]
            verdict = (
                "carries that"
                if load.total <= 100
                else "cannot carry all of that: goals are replaced by newer ones, polls are skipped"
            )
            click.echo(
                f"{name}: {len(options.servos)} servos at {options.baudrate} baud, {GOAL_HZ:g} goals/s each "
                f"and {FEEDBACK_HZ:g} Hz feedback ask {load.total:.0f} % of the line; it {verdict}"
            )

    async def main() -> int:
        async with open_rig(config) as rig:
            await rig.enable()
            before = rig.stats()
            tallies = {name: Tally() for name in config.buses}
            started = asyncio.get_running_loop().time()
            await asyncio.gather(*(_caller(servo, tallies[rig.names[servo.name][0]], started, seconds) for servo in rig))
            elapsed = asyncio.get_running_loop().time() - started
            rows = {name: _row(rig, name, tally, before[name], elapsed) for name, tally in tallies.items()}
            if as_json:
                emit(rows)
            else:
                echo_table(None, ("bus", *next(iter(rows.values()))), [(name, *row.values()) for name, row in rows.items()])
            return 1 if any(row["errors"] for row in rows.values()) else 0

    return run(main)


async def _caller(servo: Servo, tally: Tally, started: float, seconds: float) -> None:
    """Goals on a fixed grid. A goal that is not through when the next is due is replaced by it, as in any streaming caller."""
    loop, line = asyncio.get_running_loop(), LINES[servo.name.partition("/")[0]]
    pending: set[asyncio.Task[None]] = set()
    for tick in range(int(seconds * GOAL_HZ)):
        await asyncio.sleep(started + tick / GOAL_HZ - loop.time())
        position = line.middle + line.swing * math.sin(2 * math.pi * tick / GOAL_HZ / PERIOD)
        task = loop.create_task(_send(servo, position, tally))
        pending.add(task)
        task.add_done_callback(pending.discard)
    await asyncio.gather(*pending)
    await asyncio.sleep(started + seconds - loop.time())


async def _send(servo: Servo, position: float, tally: Tally) -> None:
    try:
        outcome = await servo.move_to(position)
    except ServobusError as error:
        tally.errors[type(error).__name__] += 1
    else:
        tally.outcomes[outcome] += 1


def _row(rig: LocalRig, name: str, tally: Tally, before: dict[str, Any], seconds: float) -> dict[str, Any]:
    stats = rig.stats()[name]
    goals = sum(tally.outcomes.values())
    delivered = goals - tally.outcomes[Outcome.SUPERSEDED]
    frames = stats["goal_turns"] - before["goal_turns"]  # a goal turn here is one frame: WRITE or SYNC WRITE
    feedback = stats.get("polled", 0) - before.get("polled", 0)
    servos = len(rig.config.buses[name].servos)
    return {
        "goals accepted": goals,
        "goal frames": frames,
        "goals/frame": round(delivered / frames, 2) if frames else 0.0,
        "goals/s": round(delivered / seconds, 1),
        "feedback Hz": round(feedback / servos / seconds, 1),
        "wire load %": stats["wire_load_percent"],
        "turn p50 ms": stats["turn_ms"]["p50"],
        "turn p99 ms": stats["turn_ms"]["p99"],
        "errors": sum(tally.errors.values()),
    }
