"""set-id and set-baud: one servo at a time, with the next step, or refused with the reason."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from servobus.cli import status_of

CONFIG = """\
version: 1
buses:
  gimbal:
    protocol: kst
    port: "sim:"
    servos: {pan: {id: 37}, tilt: {id: 38}}
  arm:
    protocol: sms
    port: "sim:"
    baudrate: 1000000
    servos: {elbow: {id: 1, model: sts}}
"""


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "servobus.yaml").write_text(CONFIG)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("SERVOBUS_CONFIG", raising=False)


@pytest.mark.usefixtures("rig")
def test_a_new_id_waits_for_a_restart(capsys: pytest.CaptureFixture[str]) -> None:
    assert status_of(["set-id", "gimbal", "37", "40", "--save"]) == 0
    assert capsys.readouterr().out == "pending_reboot: id 40 is set and not in effect yet: restart the servo\n"
    assert status_of(["set-id", "gimbal", "37", "40", "--json"]) == 0
    change = json.loads(capsys.readouterr().out)
    assert (change["value"], change["saved"], change["pending_reboot"]) == (40, False, True)


@pytest.mark.usefixtures("rig")
def test_a_new_baud_rate(capsys: pytest.CaptureFixture[str]) -> None:
    assert status_of(["set-baud", "gimbal", "37", "115200"]) == 0
    assert "baudrate 115200 is set and not in effect yet: save and restart the servo" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        (["set-id", "gimbal", "37", "38"], 2, "id 38 belongs to another servo"),
        (["set-id", "gimbal", "37", "255"], 2, "id 255 is outside 1 to 254"),
        (["set-id", "gimbal", "37", "256"], 2, "0<=x<=255"),
        (["set-id", "gimbal", "99", "40"], 1, "no answer"),
        (["set-id", "leg", "1", "2"], 2, "no bus 'leg': there are gimbal, arm"),
        (["set-id", "arm", "1", "2"], 2, "with the vendor's tool"),
        (["set-baud", "gimbal", "37", "31250"], 2, "baud rate 31250 is not one of"),
        (["set-baud", "arm", "1", "115200"], 2, "with the vendor's tool"),
    ],
)
@pytest.mark.usefixtures("rig")
def test_what_is_refused(arguments: list[str], status: int, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert status_of(arguments) == status
    assert message in capsys.readouterr().err
