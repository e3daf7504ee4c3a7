"""Commands on a terminal: tables, progress and logs for people."""

from __future__ import annotations

import json

import pytest

from tests.cli.processes import Terminal, servobus

pytestmark = pytest.mark.slow


def test_the_monitor_on_a_terminal_is_an_unfolded_table(rig: str, terminal: Terminal) -> None:
    arguments = ("monitor", "-c", rig, "--count", "2", "--hz", "50")
    with servobus(*arguments, stdout=terminal.end, NO_COLOR="1", TERM="xterm") as process:
        picture = terminal.rest()
        assert process.wait(20) == 0
        row = next(line for line in picture.splitlines() if "arm/shoulder" in line)
        assert row.split()[-2:] == ["online", "-"], row
        assert "health" in picture


def test_a_scan_on_a_terminal_shows_its_progress(rig: str, terminal: Terminal) -> None:
    with servobus("scan", "-c", rig, "--ids", "1-40", "--json", stderr=terminal.end, TERM="xterm") as process:
        bar = terminal.rest()
        assert process.stdout is not None
        assert len(json.loads(process.stdout.read())) == 2
        assert process.wait(20) == 0
        assert "scanning" in bar
        assert "2 found" in bar
        assert "0:00:0" in bar


@pytest.mark.parametrize(("no_color", "coloured"), [("", True), ("1", False)])
def test_logs_on_a_terminal_are_for_people(rig: str, no_color: str, coloured: bool, terminal: Terminal) -> None:
    with servobus("run", rig, "--log-every", "0.1", stderr=terminal.end, NO_COLOR=no_color) as process:
        output = ""
        while "state" not in output:
            output += terminal.some()
        process.terminate()
        output += terminal.rest()
        assert process.wait(10) == 0
        assert "running" in output
        assert ("\x1b[" in output) is coloured
