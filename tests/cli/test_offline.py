"""The commands that open no port: check, schema, decode, ports."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from servobus.cli import COMMANDS, status_of
from tests.config.mistakes import GOOD, MISTAKES, Mistake

CONFIG = Path(__file__).parents[2] / "config"


@pytest.fixture
def good(tmp_path: Path) -> Path:
    path = tmp_path / "rig.yaml"
    path.write_text(GOOD)
    return path


def test_check_prints_the_load(good: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert status_of(["check", str(good)]) == 0
    out = capsys.readouterr().out
    assert "load %" in out
    assert "rig.yaml: ok" in out
    assert status_of(["check", str(good), "--json"]) == 0
    loads = json.loads(capsys.readouterr().out)
    assert set(loads["arm"]) == {"load_percent", "goal_latency_ms", "estop_latency_ms", "silent_servo_ms"}
    assert loads["arm"]["load_percent"]["total"] == pytest.approx(
        sum(v for k, v in loads["arm"]["load_percent"].items() if k != "total"), abs=0.1
    )


@pytest.mark.parametrize("mistake", MISTAKES.values(), ids=MISTAKES)
def test_check_names_file_line_and_column(mistake: Mistake, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(mistake.text)
    assert status_of(["check", str(path)]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith(f"servobus: {path}:{mistake.line}:{mistake.column}: ")
    assert mistake.message in captured.err
    assert captured.out == ""


def test_more_than_the_line_carries_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(GOOD.replace("1000000", "9600").replace("feedback: 50", "feedback: 500"))
    assert status_of(["check", str(path)]) == 2
    assert "more than the line carries: arm (" in capsys.readouterr().err


@pytest.mark.parametrize("example", ["arm", "rs485", "sim"])
def test_the_examples_pass(example: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert status_of(["check", str(CONFIG / f"{example}.yaml")]) == 0
    assert "ok" in capsys.readouterr().out


def test_check_without_a_file(capsys: pytest.CaptureFixture[str]) -> None:
    assert status_of(["check", "no-such-file.yaml"]) == 2
    assert "there is no such file" in capsys.readouterr().err
    assert status_of(["check"]) == 2
    assert "CONFIG" in capsys.readouterr().err


def test_schema_is_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert status_of(["schema"]) == 0
    assert json.loads(capsys.readouterr().out)["title"] == "servobus config"


@pytest.mark.parametrize(
    "form", [["FF FF 01 02 01 FB"], ["ffff010201fb"], ["FF", "FF", "01", "02", "01", "FB"], ["0xFF,0xFF,0x01,0x02,0x01,0xFB"]]
)
def test_decode(form: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert status_of(["decode", *form]) == 0
    assert capsys.readouterr().out == "as a request: id 1 PING\nas a reply: id 1 status 0x01\n"


def test_decode_one_side_only_and_several_frames(capsys: pytest.CaptureFixture[str]) -> None:
    assert status_of(["decode", "--request", "FFFF010201FB FFFFFE0205FA"]) == 0
    assert capsys.readouterr().out == "id 1 PING | all ACTION\n"
    assert status_of(["decode", "--reply", "FFFF010201FB", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"frame": "ff ff 01 02 01 fb", "reply": "id 1 status 0x01"}


def test_decode_for_machines(capsys: pytest.CaptureFixture[str]) -> None:
    assert status_of(["decode", "FF FF FE 02 05 FA", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["request"] == "all ACTION"


def test_decode_of_other_bytes(capsys: pytest.CaptureFixture[str]) -> None:
    assert status_of(["decode", "01 02"]) == 0
    assert "no SMS packet" in capsys.readouterr().out
    assert status_of(["decode", "xyz"]) == 2
    assert "not hexadecimal text" in capsys.readouterr().err
    assert status_of(["decode", ","]) == 2
    assert "not hexadecimal text" in capsys.readouterr().err
    assert status_of(["decode", "FF", "--protocol", "abc"]) == 2
    assert "there are sms" in capsys.readouterr().err


def test_ports(capsys: pytest.CaptureFixture[str]) -> None:
    assert status_of(["ports"]) == 0
    assert capsys.readouterr().out
    assert status_of(["ports", "--json"]) == 0
    assert isinstance(json.loads(capsys.readouterr().out), list)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_an_example(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert status_of([command, "--help"]) == 0
    assert f"Example: servobus {command}" in " ".join(capsys.readouterr().out.split())


def test_an_unknown_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert status_of(["fly"]) == 2
    assert "No such command" in capsys.readouterr().err
    assert status_of(["--version"]) == 0
