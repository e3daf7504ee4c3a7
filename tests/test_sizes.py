"""Files and functions stay small, and no import is hidden from the linter of the floors."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.sources import PRODUCT, TESTS, name_of, parsed

MAX_FILE, MAX_FUNCTION, MAX_PRODUCT = 400, 40, 21_600
"""Lines of a file, of a function (it has fewer), of the whole package. Lower the last one when the package has become smaller."""
TYPING_ONLY = {"servobus/__init__.py"}
"""Its public names are imported when they are used; a type checker reads them here."""


def lines(path: Path) -> int:
    return len(path.read_text().splitlines())


def long_functions(path: Path) -> Iterator[str]:
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            size = (node.end_lineno or node.lineno) - node.lineno + 1
            if size >= MAX_FUNCTION:
                yield f"{node.name}: {size} lines"


@pytest.mark.parametrize("path", [*PRODUCT, *TESTS], ids=name_of)
def test_files_and_functions_are_small(path: Path) -> None:
    assert lines(path) <= MAX_FILE
    assert list(long_functions(path)) == []


def test_the_package_does_not_grow() -> None:
    assert sum(map(lines, PRODUCT)) <= MAX_PRODUCT


@pytest.mark.parametrize("path", PRODUCT, ids=name_of)
def test_no_import_hides_a_circle(path: Path) -> None:
    assert name_of(path) in TYPING_ONLY or "TYPE_CHECKING" not in path.read_text()
