"""Commands on servos, run on simulated ones: what they print, what they refuse, and with which status they end."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from servobus.cli import status_of
from tests.config.mistakes import GOOD

TWO = GOOD + GOOD.split("buses:\n")[1].replace("arm:", "leg:").replace("shoulder", "hip")


@pytest.fixture(autouse=True)
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A config where commands look for one: arm/shoulder, arm/elbow, leg/hip, leg/elbow."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("SERVOBUS_CONFIG", raising=False)
    path = tmp_path / "servobus.yaml"
    path.write_text(TWO)
    return path


class Call:
    """Runs a command and keeps its output."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys
        self.out = self.err = ""

    def __call__(self, *arguments: str) -> int:
        status = status_of(list(arguments))
        self.out, self.err = self._capsys.readouterr()
        return status

    def json(self, *arguments: str) -> Any:
        assert self(*arguments, "--json") == 0, self.err
        return json.loads(self.out)


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str]) -> Call:
    return Call(capsys)


def test_ping(call: Call) -> None:
    assert call("ping", "shoulder") == 0
    assert "arm/shoulder  there" in call.out
    assert call.json("ping") == {name: {"status": 0} for name in ("arm/shoulder", "arm/elbow", "leg/hip", "leg/elbow")}


def test_read(call: Call) -> None:
    assert call("read") == 0
    assert call.out.count("online") == 4
    state = call.json("read", "arm/elbow")["arm/elbow"]
    assert (state["position"], state["health"], state["enabled"]) == (0.0, "online", False)
    assert call("read", "shoulder", "temperature") == 0
    assert call.out == "25\n"
    assert call("read", "shoulder", "5:2") == 0
    assert call.out == "01 00\n"
    assert call.json("read", "shoulder", "id") == {"arm/shoulder": {"id": 1}}


def test_write(call: Call) -> None:
    assert call.json("write", "shoulder", "torque_limit=60") == {"arm/shoulder": {"torque_limit": 60.0}}
    assert call("write", "shoulder", "return_delay=0x10", "--raw", "--persist") == 0
    assert call.out == "arm/shoulder return_delay = 16\n"


def test_all_registers_are_checked_before_the_first_is_written(call: Call) -> None:
    assert call("write", "shoulder", "torque_limit=60", "goal_position=5", "--trace") == 2
    assert "arm/shoulder" in call.err
    assert ">" not in call.err
    assert call("write", "shoulder", "torque_limit=60", "torque_limit=70") == 2
    assert "torque_limit is named twice" in call.err


def test_move(call: Call) -> None:
    positions = call.json("move", "shoulder=-20", "leg/elbow=5.5", "--speed", "300")
    assert positions["arm/shoulder"]["position"] == pytest.approx(-20, abs=0.9)
    assert positions["leg/elbow"]["position"] == pytest.approx(5.5, abs=0.9)
    assert call("move", "shoulder=1", "--together", "--confirm") == 0
    assert "holds (on_exit)" in call.out


def test_a_goal_beyond_a_limit_energises_nothing(call: Call) -> None:
    assert call("move", "elbow=5", "shoulder=90.1", "--trace") == 2
    assert call("move", "arm/elbow=5", "shoulder=90.1", "--trace") == 2
    assert "arm/shoulder: position 90.1 is outside -90 to 90: nothing was sent" in call.err
    assert ">" not in call.err


def test_enable_disable(call: Call) -> None:
    assert call("enable", "shoulder") == 0
    assert "arm/shoulder  enabled  holds (on_exit)" in call.out
    assert call.json("enable", "shoulder") == {"arm/shoulder": {"enabled": True, "then": "hold"}}
    assert call("disable") == 0
    assert call.out.count("limp") == 4
    assert call.json("disable", "shoulder") == {"arm/shoulder": {"enabled": False, "energised": False}}


def test_stop_and_clear_without_a_daemon(call: Call) -> None:
    assert call("stop") == 0
    assert "not latched: no daemon runs" in call.err
    assert call.out.count("it was limp") == 4
    assert call.json("stop")["arm/elbow"]["confirmed"] is True
    assert call("clear") == 2
    assert "no daemon runs" in call.err


def test_monitor_and_stats(call: Call) -> None:
    assert call("monitor", "shoulder", "--count", "2", "--hz", "50", "--json") == 0
    pictures = [json.loads(line) for line in call.out.splitlines()]
    assert [list(picture) for picture in pictures] == [["arm/shoulder"]] * 2
    assert call("monitor", "arm/shoulder", "hip", "--seconds", "0.1", "--hz", "10") == 0
    assert [line.split()[:2] for line in call.out.splitlines()] == [
        ["arm/shoulder", "position=0.00"],
        ["leg/hip", "position=0.00"],
    ]
    stats = call.json("stats", "--seconds", "0.2")
    assert stats["arm"]["up"] is True
    assert stats["leg"]["nodes"]["1"]["health"] == "online"
    assert call("stats", "--seconds", "0.1") == 0
    assert "wire_load_percent" in call.out


def test_scan(call: Call, tmp_path: Path) -> None:
    hits = call.json("scan", "arm", "--ids", "0-3")
    assert [(hit["bus"], hit["id"], hit["baudrate"], hit["model"]) for hit in hits] == [
        ("arm", 1, 1000000, "sts"),
        ("arm", 2, 1000000, "sts"),
    ]
    assert all(hit["firmware"] for hit in hits)
    assert call("scan", "arm", "--ids", "1-2") == 0
    assert "STS3215" in call.out
    assert call("scan", "arm", "--ids", "1-2", "--yaml") == 0
    (tmp_path / "found.yaml").write_text(call.out)
    assert call("check", "found.yaml") == 0
    assert call("read", "servo_2", "-c", "found.yaml") == 0


def test_scan_that_finds_nobody(call: Call) -> None:
    assert call("scan", "arm", "--ids", "200-201", "--json") == 1
    assert call.out == "[]\n"
    assert call("scan", "arm", "--ids", "200") == 1
    assert "no servo answered" in call.err
    assert call("scan", "arm", "--ids", "200", "--yaml") == 1
    assert call.out == ""


def test_scan_of_a_bare_port(call: Call) -> None:
    assert call("scan", "--port", "sim:", "--baudrate", "1000000", "--ids", "7") == 1
    assert call("scan", "--port", "/dev/no-such-port", "--ids", "7") == 1
    assert "does not exist" in call.err
    assert call("scan", "--port", "sim:", "--protocol", "abc") == 2
    assert "there are sms" in call.err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--ids", "5-1"), "write ids from 0 to 253"),
        (("--ids", "253-254"), "write ids from 0 to 253"),
        (("--ids", "-1"), "write ids from 0 to 253"),
        (("--ids", "x"), "write ids from 0 to 253"),
        (("--baudrate", "fast"), "write rates from 300 to 10000000"),
        (("--baudrate", "299"), "write rates from 300"),
        (("--baudrate", "10000001"), "write rates from 300"),
        (("--port", "sim:"), "not both"),
        ((), "say which bus: there are arm, leg"),
    ],
)
def test_scan_with_bad_arguments(arguments: tuple[str, ...], message: str, call: Call) -> None:
    bus = ("arm",) if arguments else ()
    assert call("scan", *bus, *arguments) == 2
    assert message in call.err
    assert call("scan", "foot") == 2
    assert "no bus 'foot'" in call.err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("read", "knee"), "no servo 'knee': there are arm/shoulder"),
        (("read", "elbow"), "on several buses: say one of arm/elbow, leg/elbow"),
        (("read", "shoulder", "temprature"), "has no register 'temprature'"),
        (("read", "shoulder", "300:2"), "give ADDR:LEN with LEN 1 to 250"),
        (("move", "shoulder=91"), "outside -90 to 90"),
        (("move", "shoulder=nan"), "not a finite number"),
        (("move", "shoulder=inf"), "not a finite number"),
        (("move", "shoulder=fast"), "'fast' is not a number"),
        (("move", "shoulder"), "write NAME=POSITION"),
        (("move", "=5"), "write NAME=POSITION"),
        (("move", "knee=5"), "no servo 'knee'"),
        (("move",), "Missing argument"),
        (("move", "shoulder=5", "--speed", "1e9"), "shoulder"),
        (("write", "shoulder", "torque_limit"), "write REGISTER=VALUE"),
        (("write", "shoulder", "torque_limit=101"), "outside 0 to 1000"),
        (("write", "shoulder", "torque_limit=much"), "not a finite number"),
        (("write", "shoulder", "id=5"), "not written"),
        (("write", "shoulder", "return_delay=5", "--raw"), "--persist"),
        (("write", "shoulder", "goal_position=5"), "use move"),
        (("ping", "-c", "none.yaml"), "there is no such file"),
        (("enable", "knee"), "no servo 'knee'"),
        (("monitor", "--hz", "0"), "--hz"),
        (("monitor", "--hz", "nan"), "not a finite number"),
        (("monitor", "--seconds", "inf"), "not a finite number"),
        (("stats", "--seconds", "nan"), "not a finite number"),
        (("demo", "--seconds", "nan"), "not a finite number"),
        (("demo", "--seconds", "0.4"), "--seconds"),
        (("move", "shoulder=5", "--timeout", "nan"), "not a finite number"),
        (("move", "shoulder=5", "arm/shoulder=6"), "arm/shoulder is named twice"),
        (("move", "shoulder=5", "--speed", "10", "--duration", "1"), "not both"),
        (("move", "shoulder=5", "--speed", "nan"), "not a finite number"),
    ],
)
def test_a_wrong_request_ends_with_status_2(arguments: tuple[str, ...], message: str, call: Call) -> None:
    assert call(*arguments) == 2, call.out
    assert message in call.err
    assert "Traceback" not in call.err


def test_no_config_anywhere(call: Call, rig: Path) -> None:
    rig.unlink()
    assert call("read") == 2
    assert "give -c CONFIG, set SERVOBUS_CONFIG, or make ./servobus.yaml" in call.err


def test_config_from_the_environment(call: Call, rig: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rig.rename(rig.with_name("other.yaml"))
    monkeypatch.setenv("SERVOBUS_CONFIG", "other.yaml")
    assert call("read", "shoulder", "id") == 0


def test_a_missing_port_ends_with_status_1(call: Call, rig: Path) -> None:
    rig.write_text(TWO.replace('"sim:"', "/dev/no-such-port", 1))
    assert call("read", "shoulder") == 1
    assert "servobus: arm: /dev/no-such-port does not exist" in call.err
    assert call("read", "hip") == 0


def test_a_missing_port_does_not_keep_others_from_stopping(call: Call, rig: Path) -> None:
    rig.write_text(TWO.replace('"sim:"', "/dev/no-such-port", 1).replace("hip: {", "hip: {on_estop: limp, "))
    assert call("stop", "--json") == 1
    reports = json.loads(call.out)
    assert (reports["leg/hip"]["action"], reports["leg/hip"]["confirmed"]) == ("limp", True)
    assert (reports["arm/shoulder"]["written"], reports["arm/shoulder"]["confirmed"]) == (False, False)
    assert "/dev/no-such-port" in call.err


def test_a_silent_servo_ends_with_status_1(call: Call, rig: Path) -> None:
    text = TWO.replace('port: "sim:"', 'port: "sim:"\n    faults: {loss: 1.0}', 1)
    rig.write_text(text.replace("      elbow: {id: 2, model: sts}\n", "", 1))
    assert call("read", "--json") == 1
    answers = json.loads(call.out)
    assert "is it powered" in answers["arm/shoulder"]["error"]
    assert answers["leg/elbow"]["health"] == "online"
    assert call("ping", "shoulder", "hip") == 1
    assert "leg/hip       there" in call.out
    assert call("enable", "shoulder", "hip") == 1
    assert "arm/shoulder: no answer" in call.err
    assert call("stop") == 1
    assert "leg/hip" in call.out


def test_trace_shows_requests_and_replies(call: Call) -> None:
    assert call("read", "shoulder", "id", "--trace") == 0
    assert "arm > ff ff 01 04 02 05 01 f2   id 1 READ 0x05 1 bytes" in call.err
    assert "arm < ff ff 01 03 00 01 fa   id 1 ok data 01" in call.err
    assert call.out == "1\n"


def test_a_dry_run_opens_no_port(call: Call, rig: Path) -> None:
    rig.write_text(TWO.replace('"sim:"', "/dev/no-such-port", 1))
    assert call("move", "shoulder=10", "--dry-run") == 0
    assert "WRITE 0x2A" in call.out
    assert "no port is opened" in call.err
    assert call("read", "shoulder", "--dry-run", "--json") == 0
    assert json.loads(call.out)["arm/shoulder"]["position"] == 0


@pytest.mark.slow
def test_demo(call: Call) -> None:
    rows = call.json("demo", "--seconds", "0.5")
    assert {name: row["errors"] for name, row in rows.items()} == {"arm": 0, "base": 0, "gimbal": 0, "hand": 0}
    assert rows["arm"]["goals accepted"] == 300
    assert call("demo", "--seconds", "0.5") == 0
    assert "of the line; it carries that" in call.out
