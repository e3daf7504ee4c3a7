"""What a benchmark hands back: a table of figures and the targets they have to reach, as text and as JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

Row = Mapping[str, float | None]
"""One client's figures by column; None where one could not be taken."""


@dataclass(frozen=True, slots=True)
class Target:
    """A bound on one figure."""

    row: str
    column: str
    minimum: float | None = None
    maximum: float | None = None

    def text(self) -> str:
        bound = f"at least {self.minimum:g}" if self.minimum is not None else f"at most {self.maximum:g}"
        return f"{self.row}: {self.column} {bound}"

    def is_reached_by(self, figure: float | None) -> bool:
        if figure is None:
            return True
        return (self.minimum is None or figure >= self.minimum) and (self.maximum is None or figure <= self.maximum)


@dataclass(frozen=True, slots=True)
class Report:
    title: str
    rows: Mapping[str, Row]
    targets: Sequence[Target] = ()

    def missed(self) -> list[str]:
        """The targets that were missed, with the figure."""
        figures = [(target, self.rows[target.row][target.column]) for target in self.targets if target.row in self.rows]
        return [f"{target.text()}, measured {figure:.3g}" for target, figure in figures if not target.is_reached_by(figure)]

    def print(self) -> None:
        columns = list(next(iter(self.rows.values())))
        width = max(len(self.title), *map(len, self.rows))
        print(f"{self.title:{width}}", *(f"{column:>{max(9, len(column))}}" for column in columns), sep="  ")
        for name, row in self.rows.items():
            cells = (f"{_number(row[column]):>{max(9, len(column))}}" for column in columns)
            print(f"{name:{width}}", *cells, sep="  ")
        for line in self.missed():
            print(f"missed: {line}")

    def as_json(self) -> dict[str, Any]:
        return {"title": self.title, "rows": {name: dict(row) for name, row in self.rows.items()}, "missed": self.missed()}


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.0f}" if value >= 1000 else f"{value:.1f}" if value >= 10 else f"{value:.2f}"
