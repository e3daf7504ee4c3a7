"""Model files: found by name or beside the config, extended, and every mistake reported with its line and column."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from servobus.errors import ConfigError
from servobus.protocols.model_files import merged
from servobus.protocols.sms.model import FILES, packaged_models


def test_names_and_files(tmp_path: Path) -> None:
    assert FILES.find("sts", tmp_path) is packaged_models()["sts"]
    with pytest.raises(ConfigError, match="model 'stx' is not known; there are scs, sms, sms_cl, sts"):
        FILES.find("stx", tmp_path)
    with pytest.raises(ConfigError, match="there is no such file"):
        FILES.find("mine.yaml", tmp_path)


def test_a_users_model_extends_a_packaged_one(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("extends: sts\nname: mine\ntitle: Mine\nregisters: {goal_speed: {maximum: 500}}\n")
    model = FILES.read(path)
    assert model.registers["goal_speed"].maximum == 500
    assert model.registers["goal_speed"].address == 46
    assert packaged_models()["sts"].registers["goal_speed"].maximum != 500


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("extends: none\nname: x\n", ":1:10: extends: found 'none'; there are scs, sms, sms_cl, sts"),
        ("extends: sts\nregisters: {lock: {adress: 5}}\n", "did you mean address?"),
        ("extends: sts\nregisters: {lock: {address: -1}}\n", ":2:29: registers.lock.address: found -1"),
        ("extends: sts\nregisters: {lock: {address: 256}}\n", ":2:13: registers.lock: found 1 bytes at address 256"),
        ("extends: sts\nregisters: {lock: {size: 2, address: 255}}\n", "found 2 bytes at address 255; the last address is 255"),
        ("extends: sts\nregisters: {lock: {sign_bit: 8}}\n", "found sign_bit 8; its 1 bytes have bits 0 to 7"),
        ("extends: sts\nregisters: {lock: {maximum: 256}}\n", "registers.lock: found values 0 to 256; it can hold 0 to 255"),
        ("extends: sts\nregisters: {lock: {minimum: 2}}\n", "registers.lock: found values 2 to 1"),
        ("extends: sts\nregisters: {lock: {default: 256}}\n", "registers.lock: found default 256; it can hold 0 to 255"),
        ("extends: sts\nstate: {positon: lock}\n", ":2:9: state.positon: found 'positon'; expected 'position', 'goal'"),
        ("extends: sts\nfeedback: [moving, present_position]\n", "moving comes after present_position"),
        ("extends: sts\ngoal: [goal_position]\n", ":2:7: goal: found 1 here; write 3 or more"),
        ("extends: sts\ngoal: [a, b, c, d]\n", ":2:7: goal: found 4 here; write at most 3"),
        ("extends: sts\nmodes: {pwm: {modus: 1}}\n", "modus is named as a part, but the map has no such register"),
        ("extends: sts\nstate: 7\n", ":2:8: state: found no keys here; write `{key: value}`"),
        ("extends: [sts]\n", ":1:10: extends: found ['sts']; there are"),
        ("", "found no keys here; there are name, title"),
        ("extends: sts\ngoal: [goal_position, goal_speed, goal_time]\n", "do not follow one another"),
        ("extends: sts\ntorque: power\n", "power is named as a part, but the map has no such register"),
        ("name: x\n", "the key title is missing"),
    ],
)
def test_mistakes_in_a_model_file(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        FILES.read(path)
    assert message in str(caught.value)


def without(path: Path, pattern: str, instead: str) -> None:
    """A whole model file of its own with something changed that extending could not take away."""
    text, count = re.subn(pattern, instead, (FILES.folder / "sts.yaml").read_text(), count=1, flags=re.MULTILINE)
    assert count == 1
    path.write_text(text)


@pytest.mark.parametrize(
    ("pattern", "instead", "message"),
    [
        (r"^units: .*$", "units: {}", "units: found 0 here; write 1 or more"),
        (r"^  position: present_position$", "", "state: position must be there"),
        (r"^  response_status_level: .*$", "", "registers: response_status_level must be there"),
    ],
)
def test_parts_that_every_model_needs(pattern: str, instead: str, message: str, tmp_path: Path) -> None:
    without(tmp_path / "mine.yaml", pattern, instead)
    with pytest.raises(ConfigError, match=message):
        FILES.read(tmp_path / "mine.yaml")


@pytest.mark.parametrize(
    "change",
    [
        "lock: {address: 255}",
        "lock: {size: 2, address: 254}",
        "lock: {sign_bit: 7, minimum: -127, maximum: 127}",
        "lock: {maximum: 255, default: 255}",
        "lock: {minimum: 1}",
    ],
)
def test_values_at_the_edge_of_a_register(change: str, tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(f"extends: sts\nregisters: {{{change}}}\n")
    assert FILES.read(tmp_path / "mine.yaml").registers["lock"]


def test_merging() -> None:
    assert merged({"a": {"b": 1, "c": 2}, "d": [1, 2]}, {"a": {"b": 3}, "d": [9]}) == {"a": {"b": 3, "c": 2}, "d": [9]}
    assert merged(1, {"a": 1}) == {"a": 1}
