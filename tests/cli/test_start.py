"""The start of the command line: what `--help` imports, and whether the table of commands agrees with the commands."""

from __future__ import annotations

import subprocess
import sys

import click
import pytest

from servobus.cli import COMMANDS, cli, status_of

HEAVY = {"anyio", "asyncio", "msgspec", "pydantic", "rich", "ruamel", "serial", "structlog", "uvloop"}
IMPORTED = """\
import sys
from servobus.cli import status_of
status_of({arguments})
print(sorted({{name.partition('.')[0] for name in sys.modules}} & {heavy}), file=sys.stderr)
"""


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], *([name, "--help"] for name in COMMANDS)], ids=" ".join)
def test_help_imports_nothing_heavy(arguments: list[str]) -> None:
    code = IMPORTED.format(arguments=arguments, heavy=HEAVY)
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert process.stderr == "[]\n"
    assert process.stdout


def test_importing_servobus_loads_nothing_else() -> None:
    code = "import sys, servobus; print([name for name in sys.modules if name.startswith('servobus.')])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_a_command_reaches_a_daemon_without_pydantic_and_protocols() -> None:
    """An e-stop from a shell must not wait for imports that it does not need."""
    code = "import sys, servobus.cli.rig_context, servobus.cli.event_loop, servobus.cli.logs; print(*sys.modules)"
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    modules = process.stdout.split()
    assert not {"pydantic", "ruamel.yaml", "serial", "structlog", "rich"} & set(modules)
    assert not [name for name in modules if name.startswith(("servobus.protocols", "servobus.config", "servobus.engine"))]


@pytest.mark.parametrize("name", COMMANDS)
def test_the_table_has_the_first_sentence_of_each_command(name: str) -> None:
    command = cli.get_command(click.Context(cli), name)
    assert command is not None
    assert command.name == name
    assert (command.help or "").replace("\n", " ").startswith(COMMANDS[name][1])


@pytest.mark.parametrize(
    ("command", "hint"),
    [("mov", "did you mean move?"), ("set-baudrate", "did you mean set-baud?"), ("fly", "lists the commands")],
)
def test_an_unknown_command_gets_a_hint(command: str, hint: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert status_of([command]) == 2
    error = capsys.readouterr().err
    assert f"No such command '{command}'" in error
    assert hint in error


def test_the_exit_statuses_are_in_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert status_of(["--help"]) == 0
    lines = [line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines()]
    assert [line[0] for line in lines if line and line[0].isdigit()] == ["0", "1", "2", "130"]
