"""The rules of the house that a reader relies on: words, sizes, and imports that hide nothing."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.house.sources import PRODUCT, ROOT, SCRIPTS, TESTS, parsed

SOURCES = [*PRODUCT, *TESTS, *SCRIPTS]
PAGE_PATTERNS = ("*.md", "docs/*.md", "tests/*.md", "config/*.yaml", "servobus/**/*.yaml")
PAGES = [path for pattern in PAGE_PATTERNS for path in sorted(ROOT.glob(pattern))]
MAX_FILE, MAX_FUNCTION, MAX_PRODUCT = 400, 40, 24_600
"""Lines: of a file and of the package at most so many, of a function fewer. A smaller package lowers the last one."""

RETIRED = frozenset(
    [
        "keeper",
        "keepers",
        "introduction",
        "met",
        "complaint",
        "complaints",
        "gather",
        "holding",
        "claims",
        "listening",
        "mirror",
        "dial",
        "place",
        "opening",
        "reach",
        "voice",
        "work",
        "words",
        "entry",
        "digit",
        "body",
        "look",
        "pace",
        "led",
        "detour",
        "recover",
        "recovery",
        "recovering",
        "recovered",
    ]
)
"""Names that readers could not guess, whole or as a part."""
RETIRED_VARIABLES = frozenset(["told", "said", "heard", "found", "known", "seen", "looked", "least", "most", "greatest"])
"""The same for variables: a participle does not tell a type. MIN_ and MAX_ replace the superlatives."""
FIELD_NAMES = frozenset({"READ_HOLDING", "ReadHolding"})
"""Modbus calls a register so."""
RETIRED_PROSE = re.compile(
    r"\b(keepers?|introduction|complaints?|detours?|listen(ed|ing)? out|feetech\.md|the seed|seed,? (section )?\d|DESIGN)\b"
)


def parts_of(name: str) -> set[str]:
    """The words of a snake or camel case name, in lower case."""
    return {part.lower() for part in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?=[A-Z]|$|_)", name)}


def names_in(tree: ast.AST) -> Iterator[tuple[str, bool]]:
    """Every name that a file defines, and whether it is a variable."""
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                yield name, False
            case ast.arg(arg=name) | ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()):
                yield name, True
            case (
                ast.ExceptHandler(name=str(name))
                | ast.MatchAs(name=str(name))
                | ast.MatchStar(name=str(name))
                | ast.MatchMapping(rest=str(name))
                | ast.alias(asname=str(name))
            ):
                yield name, True


def retired_in(name: str, *, variable: bool) -> set[str]:
    if name in FIELD_NAMES:
        return set()
    return parts_of(name) & (RETIRED | RETIRED_VARIABLES if variable else RETIRED)


def short(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("path", SOURCES, ids=short)
def test_no_retired_word_names_anything(path: Path) -> None:
    tree = parsed(path)
    folders = path.relative_to(ROOT).parent.parts
    names = [(name, False) for name in (*folders, path.stem)] + list(names_in(tree))
    assert {name for name, variable in names if retired_in(name, variable=variable)} == set()


def test_the_rule_about_names_finds_what_it_is_for() -> None:
    tree = ast.parse(
        "class BusKeeper:\n    def look(self, told): self.found = MOST_HZ = told\n"
        "try: import io as keeper\nexcept OSError as heard: pass\n"
        "match 1:\n case {**known}: pass\n case [*seen]: pass\n case said: pass\n"
    )
    assert {name for name, variable in names_in(tree) if retired_in(name, variable=variable)} == {
        "BusKeeper",
        "look",
        "told",
        "found",
        "MOST_HZ",
        "keeper",
        "heard",
        "known",
        "seen",
        "said",
    }


@pytest.mark.parametrize("path", [*PRODUCT, *PAGES], ids=short)
def test_no_retired_word_in_texts(path: Path) -> None:
    lines = enumerate(path.read_text().splitlines(), start=1)
    assert [(number, line) for number, line in lines if RETIRED_PROSE.search(line)] == []


@pytest.mark.parametrize("path", SOURCES, ids=short)
def test_files_and_functions_are_short(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= MAX_FILE
    functions = [node for node in ast.walk(parsed(path)) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    assert [node.name for node in functions if (node.end_lineno or 0) - node.lineno + 1 >= MAX_FUNCTION] == []


def test_the_package_does_not_grow() -> None:
    assert sum(len(path.read_text().splitlines()) for path in PRODUCT) <= MAX_PRODUCT


def test_no_import_is_hidden_from_the_linter() -> None:
    """An import for the type checker alone hides a circle. The package itself has one: what it exports is loaded lazily."""
    hidden = [short(path) for path in PRODUCT if "TYPE_CHECKING" in path.read_text()]
    assert hidden == ["servobus/__init__.py"]
