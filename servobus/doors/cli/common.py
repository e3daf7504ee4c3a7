"""What the commands share: where the config is, which buses to open, how to say things, and how to run."""

from __future__ import annotations

import asyncio
import dataclasses
import functools
import json
import logging
import math
import os
import signal
import sys
from collections.abc import AsyncIterator, Callable, Collection, Coroutine, Iterable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TextIO, TypeVar, cast

import click
import structlog
from rich.console import Console
from rich.table import Table

from servobus.config import Config, load_config
from servobus.doors.cli.tracing import Tracer
from servobus.doors.cli.voice import Voice
from servobus.errors import ConfigError, DeviceError
from servobus.keeper import Trace
from servobus.local import LocalRig
from servobus.opening import open_rig
from servobus.protocols.table import PROTOCOLS
from servobus.protocols.words import State
from servobus.rig import full_name

R = TypeVar("R")
F = TypeVar("F", bound=Callable[..., Any])
DEFAULT_CONFIG = "servobus.yaml"
ENDINGS = (signal.SIGTERM, signal.SIGHUP)


class Number(click.FloatRange):
    """A finite number within a range: the range of click lets nan and inf through."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        number: float = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number.", param, ctx)
        return number


@dataclass(frozen=True)
class Options:
    """What every command on servos takes."""

    config: str | None
    as_json: bool
    trace: bool
    dry_run: bool

    @cached_property
    def setup(self) -> Config:
        """The config; on simulated servos when nothing shall be sent. Raises ConfigError."""
        if self.config is None and not Path(DEFAULT_CONFIG).exists():
            raise ConfigError(
                f"no config: give -c CONFIG, set SERVOBUS_CONFIG, or make ./{DEFAULT_CONFIG} (`servobus scan --yaml` writes one)"
            )
        config = load_config(self.config or DEFAULT_CONFIG)
        return simulated(config) if self.dry_run else config


def servo_options(command: F) -> F:
    """Adds the options and hands them over as one `options`."""

    @click.option(
        "-c", "--config", envvar="SERVOBUS_CONFIG", metavar="CONFIG", help="Bus config (YAML). Default: ./servobus.yaml."
    )
    @click.option("--json", "as_json", is_flag=True, help="For machines: one JSON document on standard output.")
    @click.option("--trace", is_flag=True, help="Print every frame, both ways and decoded, on standard error.")
    @click.option("--dry-run", is_flag=True, help="Open no port: run on simulated servos and print what would be sent.")
    @functools.wraps(command)
    def wrapper(config: str | None, as_json: bool, trace: bool, dry_run: bool, **arguments: Any) -> Any:
        return command(options=Options(config, as_json, trace, dry_run), **arguments)

    return wrapper  # type: ignore[return-value]


def simulated(config: Config) -> Config:
    """The same servos, but none of them real."""
    buses = {name: options.model_copy(update={"port": "sim:", "faults": None}) for name, options in config.buses.items()}
    return replace(config, buses=buses)


@asynccontextmanager
async def opened(
    options: Options, names: Collection[str] = (), *, only: Collection[str] = (), degraded: bool = False
) -> AsyncIterator[LocalRig]:
    """A rig with the buses of these servos, or with `only` these, or with all; `degraded`: without those whose port cannot be
    opened. Raises UnknownName before a port is opened, and DeviceError when a servo did not confirm how it was left."""
    config = options.setup
    full = [full_name(config.names, name) for name in names]
    buses = dict.fromkeys([*only, *(config.names[name][0] for name in full)])
    async with traced(config, options) as trace, open_rig(config, buses=list(buses), degraded=degraded, trace=trace) as rig:
        yield rig
    doubtful = [f"{name} ({report.action}: {report.detail})" for name, report in rig.left.items() if not report.confirmed]
    if doubtful:
        raise DeviceError(f"not confirmed how it was left: {', '.join(doubtful)}; look before you touch")


@asynccontextmanager
async def traced(config: Config, options: Options) -> AsyncIterator[Trace | None]:
    """What prints frames in words, if that is wanted. A dry run prints what would be sent, on standard output unless that is
    JSON."""
    if options.dry_run:
        click.echo("dry run: on simulated servos, no port is opened", err=True)
    if not (options.trace or options.dry_run):
        yield None
        return
    codecs = {name: PROTOCOLS[bus.protocol].codec(bus) for name, bus in config.buses.items()}
    voice = Voice(sys.stderr if options.trace or options.as_json else sys.stdout)
    tracer = Tracer(codecs, voice.say, heard=options.trace)
    try:
        yield tracer
    finally:
        tracer.close()


def run(main: Callable[[], Coroutine[Any, Any, R]], *, terminated: int = 128 + signal.SIGTERM) -> R:
    """Run it on the fastest loop there is. Ctrl-C, SIGTERM and a terminal that is closed end it in order, so that exit policies
    are applied; the status is 130 after the first, `terminated` after the others."""
    with asyncio.Runner(loop_factory=loop_factory()) as runner:
        return runner.run(_until_terminated(main, terminated))


def loop_factory() -> Callable[[], asyncio.AbstractEventLoop] | None:
    """uvloop where it is installed."""
    with suppress(ImportError):
        import uvloop

        return uvloop.new_event_loop
    return None


async def _until_terminated(main: Callable[[], Coroutine[Any, Any, R]], status: int) -> R:
    task, loop = asyncio.current_task(), asyncio.get_running_loop()
    assert task is not None
    received: list[int] = []

    def terminate() -> None:
        if received:
            os._exit(status)  # asked for a second time: at once
        received.append(status)
        task.cancel()

    for number in ENDINGS:
        loop.add_signal_handler(number, terminate)
    try:
        return await main()
    except asyncio.CancelledError:
        if received:
            raise SystemExit(status) from None
        raise
    finally:
        for number in ENDINGS:
            loop.remove_signal_handler(number)


def logs(level: int = logging.WARNING) -> None:
    """To standard error: for people on a terminal, JSON otherwise."""
    terminal = sys.stderr.isatty()
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.dev.ConsoleRenderer(colors=not os.environ.get("NO_COLOR"))
            if terminal
            else structlog.processors.JSONRenderer(),
        ],
        wrapper_class=structlog.make_filtering_bound_logger(level),
        logger_factory=structlog.WriteLoggerFactory(cast("TextIO", Voice(sys.stderr))),
        cache_logger_on_first_use=False,
    )


def emit(data: Any) -> None:
    """JSON for machines."""
    click.echo(json.dumps(data, default=_plain, allow_nan=False))


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    return str(value)


def table(title: str | None, columns: Iterable[str], rows: Iterable[Iterable[object]], *, narrow: bool = False) -> Table:
    """Numbers right, words left. `narrow`: close together, and only the last column may be folded."""
    made = Table(title=title, box=None, pad_edge=False, header_style="bold", collapse_padding=narrow)
    kept, heads = [[show(cell) for cell in row] for row in rows], list(columns)
    for index, column in enumerate(heads):
        number = bool(kept) and all(_is_number(row[index]) for row in kept)
        whole = narrow and index < len(heads) - 1
        made.add_column(column, justify="right" if number else "left", overflow="fold", no_wrap=whole)
    for row in kept:
        made.add_row(*row)
    return made


def show(value: object) -> str:
    """A cell."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.2f}"
    return ", ".join(map(str, value)) if isinstance(value, (tuple, list)) else str(value)


def _is_number(text: str) -> bool:
    return text == "-" or text.replace(".", "", 1).lstrip("-").isdigit()


def echo_table(title: str | None, columns: Iterable[str], rows: Iterable[Iterable[object]], *, narrow: bool = False) -> None:
    console = Console()
    if not console.is_terminal:
        console.width = 200  # nobody wraps a file
    console.print(table(title, columns, rows, narrow=narrow), highlight=False)


STATE_COLUMNS = ("servo", "position", "goal", "speed", "load%", "V", "°C", "A", "state", "health", "faults")
"""Narrow enough for a terminal of 80 columns."""


def state_row(name: str, state: State) -> tuple[object, ...]:
    """One servo as a row of `STATE_COLUMNS`."""
    return (
        name,
        state.position,
        state.goal,
        _tenths(state.speed),
        _tenths(state.load),
        _tenths(state.voltage),
        state.temperature,
        state.current,
        "moving" if state.moving else "enabled" if state.enabled else None,
        state.health,
        state.faults or None,
    )


def _tenths(value: float | None) -> str | None:
    return None if value is None else f"{value:.1f}"
