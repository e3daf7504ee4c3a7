"""The files that the architecture page names exist, and it names every package."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.docs.blocks import PAGES, ROOT

PAGE = PAGES["docs/architecture.md"]
FILE = re.compile(r"`((?:[a-z_<>*]+/)*[a-z_]+\.py)`")
PACKAGES = sorted(path.parent.name for path in (ROOT / "servobus").glob("*/__init__.py"))


def test_its_files_exist() -> None:
    names = {name.replace("<name>", "*") for name in FILE.findall(PAGE)}
    assert len(names) > 30
    folders = [ROOT / "servobus", *(ROOT / "servobus" / "protocols").iterdir()]
    assert [name for name in sorted(names) if not any(matches(folder, name) for folder in folders)] == []


def matches(folder: Path, name: str) -> bool:
    return any(folder.glob(name))


@pytest.mark.parametrize("package", PACKAGES)
def test_it_names_every_package(package: str) -> None:
    assert f"`{package}" in PAGE
