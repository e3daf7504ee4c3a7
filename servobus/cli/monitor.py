"""Commands that look on: monitor, stats."""

from __future__ import annotations

import asyncio
import math
import sys
from collections.abc import Callable
from typing import Any

import click
from rich.console import Console
from rich.live import Live

from servobus.cli.output import (
    STATE_COLUMNS,
    Number,
    echo_table,
    emit,
    logs,
    run,
    show,
    state_row,
    table,
)
from servobus.cli.rig_context import Options, opened, servo_options
from servobus.remote.rig import RemoteRig
from servobus.rig.interface import Rig
from servobus.rig.local import LocalRig
from servobus.values import Snapshot

MAX_HZ = 50.0


@click.command()
@click.argument("names", metavar="[NAME]...", nargs=-1)
@click.option("--hz", default=10.0, show_default=True, type=Number(0.1, MAX_HZ), help="Pictures per second.")
@click.option("--count", type=click.IntRange(min=1), help="Stop after so many pictures.")
@click.option("--seconds", type=Number(0.1), help="Stop after so long.")
@servo_options
def monitor(options: Options, names: tuple[str, ...], hz: float, count: int | None, seconds: float | None) -> int:
    """Show what the servos do, live, until Ctrl-C. Servos that the config does not poll are read at --hz.

    Positions in the servo's unit, speed in unit/s. On a terminal a table; otherwise one line for each servo and picture; with
    --json one JSON document a line, for each picture.

    Example: servobus monitor --hz 5
    """
    logs()

    async def main() -> int:
        async with opened(options, names) as rig:
            shown, most = rig.full_names(names), _most(hz, count, seconds)
            if options.as_json:
                await _pictures(rig, shown, hz, most, emit)
            elif not sys.stdout.isatty():
                await _pictures(rig, shown, hz, most, _lines)
            else:
                with Live(console=Console(), auto_refresh=False, screen=False) as live:
                    await _pictures(rig, shown, hz, most, lambda snapshot: live.update(_picture(snapshot), refresh=True))
            return 0

    return run(main)


def _most(hz: float, count: int | None, seconds: float | None) -> int | None:
    """How many pictures; None: no end."""
    limits = [limit for limit in (count, seconds and math.ceil(seconds * hz)) if limit]
    return min(limits, default=None)


def _lines(snapshot: Snapshot) -> None:
    """What is known, in one line for each servo."""
    for name, state in snapshot.items():
        cells = zip(STATE_COLUMNS[1:], state_row(name, state)[1:], strict=True)
        click.echo(f"{name}  " + "  ".join(f"{column}={show(cell)}" for column, cell in cells))


def _picture(snapshot: Snapshot) -> Any:
    return table(None, STATE_COLUMNS, [state_row(name, state) for name, state in snapshot.items()], narrow=True)


async def _unpolled(rig: Rig, names: list[str]) -> list[str]:
    """Those whose state nobody else keeps fresh."""
    if isinstance(rig, RemoteRig):
        polled = {bus: any((data["poll"] or {}).values()) for bus, data in (await rig.call("config"))["buses"].items()}
    elif isinstance(rig, LocalRig):
        polled = {bus: bool(options.poll.rates()) for bus, options in rig.config.buses.items()}
    return [name for name in names if not polled[rig.names[name][0]]]


async def _pictures(rig: Rig, names: list[str], hz: float, count: int | None, tell: Callable[[Snapshot], None]) -> None:
    unpolled = await _unpolled(rig, names)
    taken = 0
    async for _ in rig.watch(hz):
        await asyncio.gather(*(rig.read(name, max_age=0.5 / hz) for name in unpolled), return_exceptions=True)
        snapshot = rig.snapshot()
        tell({name: snapshot[name] for name in names})
        taken += 1
        if taken == count:
            return


@click.command()
@click.option("--seconds", default=2.0, show_default=True, type=Number(0.1, 3600), help="How long to count without a daemon.")
@servo_options
def stats(options: Options, seconds: float) -> int:
    """Tell what the lines carried and how long turns took: of a daemon since its start; without one, after polling for a while.

    Example: servobus stats --seconds 10
    """
    logs()

    async def main() -> int:
        async with opened(options) as rig:
            if isinstance(rig, LocalRig):
                await asyncio.sleep(seconds)
            found = rig.stats()
            if options.as_json:
                emit(found)
                return 0
            for bus, counts in found.items():
                rows = [(name, value) for name, value in counts.items() if not isinstance(value, dict)]
                turn = counts["turn_ms"]
                rows.append(("turn ms p50 / p99 / max", f"{turn['p50']} / {turn['p99']} / {turn['max']}"))
                echo_table(bus, ("counter", "value"), rows)
                nodes = [(node, *entry.values()) for node, entry in counts["nodes"].items()]
                echo_table(None, ("id", "health", "misses", "deadline ms"), nodes)
            return 0

    return run(main)
