"""Tables and messages on a standard output that is not UTF-8."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from contextlib import redirect_stdout
from pathlib import Path

import pytest

from servobus.cli import status_of
from tests.config.mistakes import GOOD

TABLES = [
    ["check", "rüg.yaml"],
    ["ports"],
    ["scan", "arm", "--ids", "1-2"],
    ["ping"],
    ["read"],
    ["monitor", "--count", "1"],
    ["stats", "--seconds", "0.1"],
    ["move", "shoulder=1"],
    ["enable"],
    ["disable"],
    ["stop"],
    ["demo", "--seconds", "0.5"],
]
"""Every command that prints a table."""


@pytest.fixture(autouse=True)
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "rüg.yaml"
    path.write_text(GOOD)
    monkeypatch.setenv("SERVOBUS_CONFIG", str(path))
    return path


def printed(arguments: list[str], encoding: str) -> str:
    """What a command that succeeds prints on a standard output of this encoding."""
    out = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
    with redirect_stdout(out):
        assert status_of(arguments) == 0
        out.flush()
    return out.buffer.getvalue().decode(encoding)


@pytest.mark.parametrize("arguments", TABLES, ids=lambda arguments: str(arguments[0]))
def test_every_table_in_ascii(arguments: list[str]) -> None:
    assert printed(arguments, "ascii").isascii()


@pytest.mark.parametrize(("encoding", "unit"), [("ascii", " C "), ("latin-1", "°C"), ("utf-8", "°C")])
def test_the_table_of_states_in_every_encoding(encoding: str, unit: str) -> None:
    assert unit in printed(["read"], encoding).splitlines()[0]


@pytest.mark.parametrize(("encoding", "path"), [("ascii", "r?g.yaml"), ("utf-8", "rüg.yaml")])
def test_a_path_in_every_encoding(encoding: str, path: str) -> None:
    assert printed(["check", "rüg.yaml"], encoding).endswith(f"{path}: ok\n")


def test_a_substitute_keeps_the_columns_aligned() -> None:
    in_ascii, in_utf_8 = (printed(["read"], encoding).splitlines() for encoding in ("ascii", "utf-8"))
    assert in_ascii[0] == in_utf_8[0].replace("°", " ")


@pytest.mark.parametrize(
    "environment", [{"PYTHONIOENCODING": "ascii"}, {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}]
)
@pytest.mark.slow
def test_a_process_without_utf_8(environment: dict[str, str], config: Path) -> None:
    process = subprocess.run(
        [sys.executable, "-m", "servobus", "read", "-c", str(config)],
        capture_output=True,
        env={**os.environ, **environment},
        timeout=60,
        check=False,
    )
    assert (process.returncode, process.stderr) == (0, b"")
    assert b"arm/shoulder" in process.stdout
    assert process.stdout.isascii()
