"""One word for one thing: names of the code keep to the words of docs/architecture.md, and retired words stay out."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.sources import PRODUCT, ROOT, TESTS, name_of, parsed

RETIRED = frozenset(
    re.findall(
        r"\w+",
        """keeper introduction met complaint complaints gather holding claims listening mirror dial place opening reach voice work
        words entry digit body look pace led detour recover recovery recovering recovered told said heard found known least most
        greatest seen looked""",
    )
)
"""Words that readers could not guess, or that name what happened to a value instead of the value."""
TERMS = frozenset({"READ_HOLDING", "ReadHolding", "read_holding_registers"})
"""Names of a protocol's document."""
PART = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?=[A-Z]|$|_)")
DISTINCTIVE = re.compile(
    r"\b(keepers?|complaints?|listened out|listening out|detours?|is met\b|are met\b|nobody asked|was led)\b", re.IGNORECASE
)
"""Retired words that no ordinary sentence needs."""
MODULES = [*PRODUCT, *TESTS]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
PAGES += [path for pattern in ("docs/*.md", "config/*.yaml", "servobus/**/*.yaml") for path in sorted(ROOT.glob(pattern))]


def names(tree: ast.Module) -> Iterator[str]:
    """Every name that a module defines."""
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name) | ast.arg(arg=name):
                yield name
            case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()):
                yield name


def retired(name: str) -> bool:
    return name not in TERMS and not RETIRED.isdisjoint(part.lower() for part in PART.findall(name))


def texts(tree: ast.Module) -> Iterator[str]:
    """Docstrings and messages."""
    return (node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str))


@pytest.mark.parametrize("name", ["known_rates", "RigKeeper", "_said", "ReachOptions", "MOST_BYTES"])
def test_retired_names_are_recognised(name: str) -> None:
    assert retired(name)
    assert not any(map(retired, ("network", "ReadHolding", "mostly", "dialog", "unknown", "wordlist")))


def test_names_of_modules_are_current() -> None:
    assert [name_of(path) for path in MODULES if retired(path.stem)] == []


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_names_in_code_are_current(path: Path) -> None:
    assert sorted({name for name in names(parsed(path)) if retired(name)}) == []


@pytest.mark.parametrize("path", PRODUCT, ids=name_of)
def test_messages_and_docstrings_are_current(path: Path) -> None:
    assert [text for text in texts(parsed(path)) if DISTINCTIVE.search(text)] == []


@pytest.mark.parametrize("path", PAGES, ids=name_of)
def test_pages_are_current(path: Path) -> None:
    assert [line for line in path.read_text().splitlines() if DISTINCTIVE.search(line)] == []


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_documents_are_named_by_name_and_section(path: Path) -> None:
    """No comment refers to a file that is not in the repository."""
    if path != Path(__file__):
        assert re.findall(r"\bDESIGN\b.*|\bfeetech\.md\b.*|\bfaults page\b.*|\bseed\.? ?[0-9]+\.[0-9].*", path.read_text()) == []
