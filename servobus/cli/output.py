"""What the commands print: lines, JSON for machines, tables for people; on a stream of any encoding.

rich, which makes the tables, is imported with the first table.
"""

from __future__ import annotations

import codecs
import dataclasses
import io
import json
import sys
from collections.abc import Iterable
from typing import Any

import click

from servobus.values import State

ENCODING_ERRORS = "servobus.replace"
SUBSTITUTES = {"°": " ", "µ": "u", "…": ".", "│": "|", "─": "-", "━": "-"}
"""Character -> its substitute in an encoding that lacks it, of one character, so that columns stay aligned."""
FILE_WIDTH = 200  # characters, so that no row is folded in a file
STATE_COLUMNS = ("servo", "position", "goal", "speed", "load%", "V", "°C", "A", "state", "health", "faults")
"""Narrow enough for a terminal of 80 columns."""


def accept_any_encoding() -> None:
    """Let standard output and standard error substitute the characters that their encoding lacks."""
    codecs.register_error(ENCODING_ERRORS, _substitute)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors=ENCODING_ERRORS)


def _substitute(error: UnicodeError) -> tuple[str, int]:
    assert isinstance(error, UnicodeEncodeError)
    text = error.object[error.start : error.end]
    return "".join(SUBSTITUTES.get(char, "?") for char in text), error.end


def echo(text: str, *, err: bool = False, end: str = "\n") -> None:
    """Print a text on standard output, or on standard error, at once."""
    print(text, end=end, file=sys.stderr if err else sys.stdout, flush=True)


def emit(data: Any) -> None:
    """Print one JSON document, for machines, and note for the end of the command that it has one."""
    context = click.get_current_context(silent=True)
    if context is not None and context.obj is not None:
        context.obj.emitted = True
    echo(json.dumps(data, default=_plain, allow_nan=False))


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    return str(value)


def table(title: str | None, columns: Iterable[str], rows: Iterable[Iterable[object]], *, narrow: bool = False) -> Any:
    """Make a rich Table with numbers on the right and text on the left.

    `narrow` puts columns close together, and lets only the last one be folded.
    """
    from rich.table import Table

    made = Table(title=title, box=None, pad_edge=False, header_style="bold", collapse_padding=narrow)
    cells, headings = [[show(cell) for cell in row] for row in rows], list(columns)
    for index, heading in enumerate(headings):
        numeric = bool(cells) and all(_is_number(row[index]) for row in cells)
        no_wrap = narrow and index < len(headings) - 1
        made.add_column(heading, justify="right" if numeric else "left", overflow="fold", no_wrap=no_wrap)
    for row in cells:
        made.add_row(*row)
    return made


def _is_number(text: str) -> bool:
    return text == "-" or text.replace(".", "", 1).lstrip("-").isdigit()


def echo_table(title: str | None, columns: Iterable[str], rows: Iterable[Iterable[object]], *, narrow: bool = False) -> None:
    """Print a table; where the output is not a terminal, no row is folded."""
    from rich.console import Console

    console = Console()
    if not console.is_terminal:
        console.width = FILE_WIDTH
    console.print(table(title, columns, rows, narrow=narrow), highlight=False)


def report(as_json: bool, data: Any, columns: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    """Print the result of a command: `data` for machines, or a table for people."""
    if as_json:
        emit(data)
    else:
        echo_table(None, columns, rows)


def show(value: object) -> str:
    """The text of a cell."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.2f}"
    return ", ".join(map(str, value)) if isinstance(value, (tuple, list)) else str(value)


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
        "moving" if state.moving else "enabled" if state.enabled else "energised" if state.energised else None,
        state.health,
        state.faults or None,
    )


def _tenths(value: float | None) -> str | None:
    return None if value is None else f"{value:.1f}"
