"""What the commands share: how to say things, and how to run. How they come by a rig stands in `reach`."""

from __future__ import annotations

import asyncio
import dataclasses
import json
import logging
import math
import os
import signal
import sys
from collections.abc import Callable, Coroutine, Iterable, MutableMapping, Sequence
from contextlib import suppress
from typing import Any, TextIO, TypeVar, cast

import click
import structlog
from rich.console import Console
from rich.table import Table

from servobus.cli.safe_stream import SafeStream
from servobus.values import State

R = TypeVar("R")
ENDINGS = (signal.SIGTERM, signal.SIGHUP)


class Number(click.FloatRange):
    """A finite number within a range: the range of click lets nan and inf through."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        number: float = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number.", param, ctx)
        return number


def run(
    main: Callable[[], Coroutine[Any, Any, R]],
    *,
    terminated: int = 128 + signal.SIGTERM,
    endings: Sequence[signal.Signals] = ENDINGS,
) -> R:
    """Run it on the fastest loop there is. Ctrl-C, and the signals `endings` (SIGTERM, a terminal that is closed), end it in
    order, so that exit policies are applied; the status is 130 after the first, `terminated` after the others."""
    with asyncio.Runner(loop_factory=loop_factory()) as runner:
        return runner.run(_until_terminated(main, terminated, endings))


def loop_factory() -> Callable[[], asyncio.AbstractEventLoop] | None:
    """uvloop where it is installed."""
    with suppress(ImportError):
        import uvloop

        return uvloop.new_event_loop
    return None


async def _until_terminated(main: Callable[[], Coroutine[Any, Any, R]], status: int, endings: Sequence[signal.Signals]) -> R:
    task, loop = asyncio.current_task(), asyncio.get_running_loop()
    assert task is not None
    received: list[int] = []

    def terminate() -> None:
        if received:
            os._exit(status)  # asked for a second time: at once
        received.append(status)
        task.cancel()

    for number in endings:
        loop.add_signal_handler(number, terminate)
    try:
        return await main()
    except asyncio.CancelledError:
        if received:
            raise SystemExit(status) from None
        raise
    finally:
        for number in endings:
            loop.remove_signal_handler(number)


def logs(level: int = logging.WARNING) -> None:
    """The `servobus` tree of `logging` goes to standard error: for people on a terminal, JSON otherwise."""
    renderer: Any = structlog.processors.JSONRenderer()
    if sys.stderr.isatty():
        renderer = structlog.dev.ConsoleRenderer(colors=not os.environ.get("NO_COLOR"))
    handler = logging.StreamHandler(cast("TextIO", SafeStream(sys.stderr)))
    handler.setFormatter(
        structlog.stdlib.ProcessorFormatter(
            processors=[
                _event_and_fields,
                structlog.processors.add_log_level,
                structlog.processors.TimeStamper(fmt="iso", utc=True),
                structlog.stdlib.ProcessorFormatter.remove_processors_meta,
                renderer,
            ]
        )
    )
    logger = logging.getLogger("servobus")
    logger.handlers, logger.propagate = [handler], False
    logger.setLevel(level)


def _event_and_fields(_: Any, __: str, event: MutableMapping[str, Any]) -> MutableMapping[str, Any]:
    """What `servobus.rig.logs` put beside the text, as keys of their own."""
    record = event["_record"]
    fields = getattr(record, "servobus_fields", {})
    return {**fields, **event, "event": getattr(record, "servobus_event", event["event"])}


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
