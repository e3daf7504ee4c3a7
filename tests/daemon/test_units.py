"""The files of the service: what they say, and how they are written."""

from __future__ import annotations

import configparser
import shutil
import subprocess
from pathlib import Path, PurePosixPath

import pytest
from click.testing import CliRunner

from servobus.cli import cli
from servobus.daemon import units

SERVICE = PurePosixPath("/etc/systemd/system/servobus.service")
RIG = 'version: 1\nbuses: {a: {protocol: sms, port: "sim:", baudrate: 1000000, servos: {s: {id: 1, model: sts}}}}\n'


def unit(**options: bool) -> dict[str, str]:
    parser = configparser.RawConfigParser(strict=False)
    parser.optionxform = str  # type: ignore[assignment, method-assign]
    parser.read_string(units.files("servobus", "rig.yaml", **options)[SERVICE])
    return dict(parser["Service"])


def test_the_unit_says_what_the_daemon_does() -> None:
    service = unit()
    assert service["ExecStart"] == "servobus run rig.yaml"
    assert (service["Type"], service["Restart"], service["RestartPreventExitStatus"]) == ("notify", "on-failure", "2")
    assert (service["RuntimeDirectory"], service["RuntimeDirectoryMode"]) == ("servobus", "0750")
    assert service["RuntimeDirectoryPreserve"] == "yes", "the e-stop's latch is kept there"
    assert "PrivateDevices" not in service, "it would hide the ports"


@pytest.mark.parametrize(("network", "families"), [(False, "AF_UNIX"), (True, "AF_UNIX AF_INET AF_INET6")])
def test_the_network_only_where_it_is_needed(network: bool, families: str) -> None:
    service = unit(network=network)
    assert service["RestrictAddressFamilies"] == families
    assert ("PrivateNetwork" in service) is not network


@pytest.mark.parametrize(("word", "written"), [("/a/b", "/a/b"), ("/a b", '"/a b"'), ("50%$", "50%%$$"), ('a"', '"a\\""')])
def test_any_path_is_one_word(word: str, written: str) -> None:
    assert f"ExecStart={written} run " in units.files(word)[SERVICE]


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="there is no systemd-analyze here")
def test_systemd_finds_it_safe(tmp_path: Path) -> None:
    paths = units.write(units.files("/bin/true"), tmp_path)
    path = next(path for path in paths if path.suffix == ".service")
    command = ["systemd-analyze", "security", "--offline=true", "--threshold=20", str(path)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr


def test_nothing_of_others_is_overwritten(tmp_path: Path) -> None:
    texts = units.files("servobus")
    first, *others = units.write(texts, tmp_path)
    assert units.write(texts, tmp_path) == [first, *others], "the same again is no harm"
    first.write_text("mine")
    others[0].unlink()
    with pytest.raises(FileExistsError, match="--force"):
        units.write(texts, tmp_path)
    assert first.read_text() == "mine"
    assert not others[0].exists()
    units.write(texts, tmp_path, force=True)
    assert first.read_text() == texts[SERVICE]


def test_the_command_prints_or_writes(tmp_path: Path) -> None:
    config = tmp_path / "rig.yaml"
    config.write_text(RIG)
    printed = CliRunner().invoke(cli, ["install-service", str(config)])
    assert printed.exit_code == 0
    assert "RestrictAddressFamilies=AF_UNIX\n" in printed.output
    config.write_text(RIG.replace("sim:", "tcp://127.0.0.1:4001"))
    written = CliRunner().invoke(cli, ["install-service", str(config), "--write", "--root", str(tmp_path / "root")])
    assert written.exit_code == 0
    assert "systemctl enable --now servobus" in written.output
    text = (tmp_path / "root/etc/systemd/system/servobus.service").read_text()
    assert "AF_INET" in text
    assert str(config) in text


def test_a_config_that_is_wrong_is_not_installed(tmp_path: Path) -> None:
    config = tmp_path / "rig.yaml"
    config.write_text("version: 2\n")
    result = CliRunner().invoke(cli, ["install-service", str(config), "--write", "--root", str(tmp_path / "root")])
    assert "rig.yaml:1:10" in str(result.exception)
    assert not (tmp_path / "root").exists()


def test_a_config_that_does_not_exist_yet_is_named(tmp_path: Path) -> None:
    result = CliRunner().invoke(cli, ["install-service", str(tmp_path / "later.yaml")])
    assert result.exit_code == 0
    assert "does not exist yet" in result.output
