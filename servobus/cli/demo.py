"""The rig of `servobus demo`: four simulated lines, and one caller for each servo that streams goals while feedback is polled."""

from __future__ import annotations

import asyncio
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from servobus.cli.checks import line_loads
from servobus.cli.output import echo, echo_table, emit
from servobus.config.loader import Config, parse_config
from servobus.errors import ServobusError
from servobus.rig.interface import Servo
from servobus.rig.local import LocalRig, open_rig
from servobus.values import Outcome

GOAL_HZ = 100.0
FEEDBACK_HZ = 50.0
FINGERS = ("thumb_bend", "index", "middle", "ring", "little", "thumb_rotation")
PERIOD_S = 4.0  # duration of one swing


@dataclass(frozen=True)
class DemoBus:
    """A bus of the demo; its servos swing about `middle`, in their unit."""

    protocol: str
    baudrate: int
    servos: Sequence[str]
    middle: float = 0.0
    swing: float = 30.0


BUSES = {
    "arm": DemoBus("sms", 1_000_000, [f"sts{number}: {{id: {number}, model: sts, max_speed: 300}}" for number in range(1, 7)]),
    "base": DemoBus("sms", 115_200, [f"sms{number}: {{id: {number}, model: sms, max_speed: 300}}" for number in range(1, 5)]),
    "gimbal": DemoBus("kst", 512_000, [f"kst{number}: {{id: {number}, max_speed: 300}}" for number in range(1, 5)]),
    "hand": DemoBus("roh", 115_200, [f"{channel}: {{id: 2, channel: {channel}}}" for channel in FINGERS], middle=50, swing=40),
}


def config_text() -> str:
    """The config of the demo, as YAML."""
    text = "version: 1\nbuses:\n"
    for name, bus in BUSES.items():
        text += f"  {name}:\n    protocol: {bus.protocol}\n    port: 'sim:'\n    baudrate: {bus.baudrate}\n"
        text += f"    poll: {{feedback: {FEEDBACK_HZ:g}}}\n    goal_rate: {GOAL_HZ:g}\n    servos:\n"
        text += "".join(f"      {servo}\n" for servo in bus.servos)
    return text


async def stream(seconds: float, *, as_json: bool) -> int:
    """Stream goals for some seconds and print the result. Returns the exit status."""
    config = parse_config(config_text(), "demo")
    if not as_json:
        _print_loads(config)
    async with open_rig(config) as rig:
        await rig.enable()
        before = rig.stats()
        results: dict[str, Counter[str]] = {name: Counter() for name in config.buses}
        start = asyncio.get_running_loop().time()
        await asyncio.gather(*(_caller(servo, results[rig.names[servo.name][0]], start, seconds) for servo in rig))
        elapsed = asyncio.get_running_loop().time() - start
        rows = {name: _row(rig, name, counts, before[name], elapsed) for name, counts in results.items()}
    if as_json:
        emit(rows)
    else:
        echo_table(None, ("bus", *next(iter(rows.values()))), [(name, *row.values()) for name, row in rows.items()])
    return 1 if any(row["errors"] for row in rows.values()) else 0


def _print_loads(config: Config) -> None:
    for name, load in line_loads(config).items():
        options = config.buses[name]
        overload = "cannot carry all of that: newer goals replace older ones, and polls are skipped"
        demand = f"{GOAL_HZ:g} goals/s each and {FEEDBACK_HZ:g} Hz feedback ask {load.total:.0f} % of the line"
        verdict = "carries that" if load.total <= 100 else overload
        echo(f"{name}: {len(options.servos)} servos at {options.baudrate} baud, {demand}; it {verdict}")


async def _caller(servo: Servo, results: Counter[str], start: float, seconds: float) -> None:
    """Sends goals on a fixed grid. A goal that has not left when the next one is due is replaced, as in any streaming caller."""
    loop, bus = asyncio.get_running_loop(), BUSES[servo.name.partition("/")[0]]
    pending: set[asyncio.Task[None]] = set()
    for tick in range(int(seconds * GOAL_HZ)):
        await asyncio.sleep(start + tick / GOAL_HZ - loop.time())
        position = bus.middle + bus.swing * math.sin(2 * math.pi * tick / GOAL_HZ / PERIOD_S)
        task = loop.create_task(_send(servo, position, results))
        pending.add(task)
        task.add_done_callback(pending.discard)
    await asyncio.gather(*pending)
    await asyncio.sleep(start + seconds - loop.time())


async def _send(servo: Servo, position: float, results: Counter[str]) -> None:
    """Counts how the goal ends: its outcome, or the class of its error."""
    try:
        results[await servo.move_to(position)] += 1
    except ServobusError as error:
        results[type(error).__name__] += 1


def _row(rig: LocalRig, name: str, results: Counter[str], before: dict[str, Any], seconds: float) -> dict[str, Any]:
    stats = rig.stats()[name]
    goals = sum(results[outcome] for outcome in Outcome)
    delivered = goals - results[Outcome.SUPERSEDED]
    frames = stats["goal_turns"] - before["goal_turns"]  # each goal turn of the demo is one frame
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
        "errors": results.total() - goals,
    }
