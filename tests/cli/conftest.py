"""Fixtures of the commands: the logging of the process is restored, a config file, a terminal."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from tests.cli.processes import LIMP, Terminal


@pytest.fixture(autouse=True)
def _logging_as_before() -> Iterator[None]:
    yield
    logger = logging.getLogger("servobus")
    logger.handlers, logger.propagate = [logging.NullHandler()], True
    logger.setLevel(logging.NOTSET)


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    with closing(Terminal()) as made:
        yield made


@pytest.fixture
def rig(tmp_path: Path) -> str:
    path = tmp_path / "rig.yaml"
    path.write_text(LIMP)
    return str(path)
