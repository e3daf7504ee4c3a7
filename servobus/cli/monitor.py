"""Commands that show what happens: monitor, stats."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping
from typing import Any

import click

from servobus.cli.options import Number, Options, RigContext, on_rig, servo_options
from servobus.cli.output import STATE_COLUMNS, echo, echo_table, emit, show, state_row, table
from servobus.values import State

MAX_HZ = 50.0


@click.command()
@click.argument("names", metavar="[NAME]...", nargs=-1)
@click.option("--hz", default=10.0, show_default=True, type=Number(0.1, MAX_HZ), help="Updates per second.")
@click.option("--count", type=click.IntRange(min=1), help="Stop after this number of updates.")
@click.option("--seconds", type=Number(0.1), metavar="SECONDS", help="Stop after this time.")
@servo_options
def monitor(options: Options, names: tuple[str, ...], hz: float, count: int | None, seconds: float | None) -> None:
    """Show the state of servos, live. Ends with Ctrl-C. Without a NAME all servos are shown.

    Positions are in the servo's unit, speed in unit/s, load in percent. A servo that the config does not poll is read at --hz. On
    a terminal the output is a table; otherwise each update is one line a servo, with --json one JSON document.

    Example: servobus monitor --hz 5
    """

    async def action(context: RigContext) -> None:
        updates = min([limit for limit in (count, seconds and math.ceil(seconds * hz)) if limit], default=None)
        if sys.stdout.isatty() and not options.as_json:
            await _show_live(context, names, hz, updates)
        else:
            await _show(context, names, hz, updates, emit if options.as_json else _print_lines)

    on_rig(options, action, names)


def _print_lines(snapshot: Mapping[str, State]) -> None:
    for name, state in snapshot.items():
        cells = zip(STATE_COLUMNS[1:], state_row(name, state)[1:], strict=True)
        echo(f"{name}  " + "  ".join(f"{column}={show(cell)}" for column, cell in cells))


async def _show_live(context: RigContext, names: tuple[str, ...], hz: float, count: int | None) -> None:
    from rich.console import Console
    from rich.live import Live

    def update(snapshot: Mapping[str, State]) -> None:
        rows = [state_row(name, state) for name, state in snapshot.items()]
        live.update(table(None, STATE_COLUMNS, rows, narrow=True), refresh=True)

    with Live(console=Console(), auto_refresh=False, screen=False) as live:
        await _show(context, names, hz, count, update)


async def _show(
    context: RigContext, names: tuple[str, ...], hz: float, count: int | None, show_snapshot: Callable[[dict[str, State]], None]
) -> None:
    from asyncio import gather

    rig, buses = context.rig, await context.buses()
    shown = rig.full_names(names)
    unpolled = [name for name in shown if not buses[rig.names[name][0]].polled]
    done = 0
    async for _ in rig.watch(hz):
        await gather(*(rig.read(name, max_age=0.5 / hz) for name in unpolled), return_exceptions=True)
        snapshot = rig.snapshot()
        show_snapshot({name: snapshot[name] for name in shown})
        done += 1
        if done == count:
            return


@click.command()
@click.option(
    "--seconds", default=2.0, show_default=True, type=Number(0.1, 3600), help="Time to poll and count without a daemon."
)
@servo_options
def stats(options: Options, seconds: float) -> None:
    """Print the counters and times of each line. A daemon counts since its start; without one the command polls for a while.

    Turn times and deadlines are in ms, loads in percent of the line's time.

    Example: servobus stats --seconds 10
    """

    async def action(context: RigContext) -> None:
        from asyncio import sleep

        if not context.has_daemon:
            await sleep(seconds)
        result = context.rig.stats()
        if options.as_json:
            emit(result)
        else:
            for bus, counts in result.items():
                _print_stats(bus, counts)

    on_rig(options, action)


def _print_stats(bus: str, counts: Mapping[str, Any]) -> None:
    turn = counts["turn_ms"]
    rows = [(name, value) for name, value in counts.items() if not isinstance(value, dict)]
    rows.append(("turn ms p50 / p99 / max", f"{turn['p50']} / {turn['p99']} / {turn['max']}"))
    echo_table(bus, ("counter", "value"), rows)
    nodes = [(node, *values.values()) for node, values in counts["nodes"].items()]
    echo_table(None, ("id", "health", "misses", "deadline ms"), nodes)
