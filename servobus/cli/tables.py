"""Tables for people. Imports rich, so a command imports this module when it prints."""

from __future__ import annotations

from collections.abc import Iterable

from rich.console import Console
from rich.table import Table

from servobus.cli.output import show

FILE_WIDTH = 200
"""Width in characters where the output is not a terminal, so that no row is folded."""


def table(title: str | None, columns: Iterable[str], rows: Iterable[Iterable[object]], *, narrow: bool = False) -> Table:
    """Make a table with numbers on the right and text on the left.

    Args:
        title: Heading above the table.
        columns: Heading of each column.
        rows: The cells, as `show` takes them.
        narrow: Puts columns close together; only the last one may be folded.
    """
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


def print_table(title: str | None, columns: Iterable[str], rows: Iterable[Iterable[object]], *, narrow: bool = False) -> None:
    console = Console()
    if not console.is_terminal:
        console.width = FILE_WIDTH
    console.print(table(title, columns, rows, narrow=narrow), highlight=False)
