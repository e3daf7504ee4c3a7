"""A daemon that was named, or that has died, is never replaced by ports of this process: they are those of another rig."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from servobus.cli import status_of
from servobus.rpc.socket_path import find_socket
from tests.cli.processes import LIMP, servobus, until

pytestmark = pytest.mark.slow

VERBS = [
    ("ping",),
    ("read",),
    ("read", "shoulder", "id"),
    ("write", "shoulder", "torque_limit=60"),
    ("monitor", "--count", "1"),
    ("stats", "--seconds", "0.1"),
    ("move", "shoulder=5"),
    ("enable",),
    ("disable",),
    ("stop",),
    ("clear",),
    ("scan", "arm", "--ids", "1"),
    ("set-id", "arm", "1", "7"),
    ("set-baud", "arm", "1", "500000"),
    ("command", "arm", "1", "restart"),
]
every_verb = pytest.mark.parametrize("verb", VERBS, ids=" ".join)


@pytest.fixture(autouse=True)
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A config where commands look for one."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "servobus.yaml").write_text(LIMP)


@pytest.fixture
def dead_port() -> Iterator[str]:
    """A TCP address that nobody else can take, and at which nobody listens."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        yield f"tcp://127.0.0.1:{taken.getsockname()[1]}"


def left_over(path: Path) -> Path:
    """The socket file of a daemon that has died."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with socket.socket(socket.AF_UNIX) as died:
        died.bind(str(path))
    return path


@pytest.fixture
def usual_socket() -> Path:
    path = left_over(Path(os.environ["XDG_RUNTIME_DIR"]) / "servobus" / "servobus.sock")
    assert find_socket() == path
    return path


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert status_of([*arguments, "--trace"]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert " > " not in err, "no frame left"
    assert "no daemon listens at" in err
    assert "--direct" in err
    return err


@every_verb
@pytest.mark.parametrize("kind", ["tcp", "missing", "left over"])
def test_a_named_daemon_that_does_not_answer_is_an_error(
    verb: tuple[str, ...],
    kind: str,
    dead_port: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    addresses = {"tcp": dead_port, "missing": str(tmp_path / "none.sock"), "left over": str(left_over(tmp_path / "s.sock"))}
    refused(capsys, *verb, "--socket", addresses[kind])
    monkeypatch.setenv("SERVOBUS_SOCKET", addresses[kind])
    refused(capsys, *verb)
    assert "SERVOBUS_SOCKET" in refused(capsys, *verb, "-c", "servobus.yaml")


@every_verb
def test_a_daemon_that_has_died_is_an_error(
    verb: tuple[str, ...], usual_socket: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "-c CONFIG" in refused(capsys, *verb)
    monkeypatch.setenv("SERVOBUS_CONFIG", "servobus.yaml")
    refused(capsys, *verb)


def test_who_says_whose_ports_gets_them(
    usual_socket: Path, dead_port: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments in (["-c", "servobus.yaml"], ["--direct"], ["--dry-run"]):
        assert status_of(["read", "shoulder", "id", *arguments, "--json"]) == 0
        assert json.loads(capsys.readouterr().out) == {"arm/shoulder": {"id": 1}}
    monkeypatch.setenv("SERVOBUS_SOCKET", dead_port)
    for arguments in (["--direct"], ["--dry-run"]):
        assert status_of(["read", "shoulder", "id", *arguments, "--json"]) == 0
        assert json.loads(capsys.readouterr().out) == {"arm/shoulder": {"id": 1}}
    assert status_of(["read", "--socket", dead_port, "--direct"]) == 2
    assert "give one of them" in capsys.readouterr().err


def test_a_daemon_does_not_listen_at_a_tcp_address_of_the_environment(
    dead_port: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("SERVOBUS_SOCKET", dead_port)
    assert status_of(["run", "servobus.yaml"]) == 2
    assert "a daemon listens at a path" in capsys.readouterr().err


def test_a_named_daemon_and_a_config_of_another_rig_are_not_guessed_between(tmp_path: Path) -> None:
    """Both were named, and a command for one of them must not reach the other."""
    other = tmp_path / "other.yaml"
    other.write_text(LIMP.replace("arm:", "leg:"))
    there = str(tmp_path / "d" / "s.sock")
    with servobus("run", "servobus.yaml", SERVOBUS_SOCKET=there) as daemon:
        until(daemon, "running")
        for verb in (("move", "shoulder=5"), ("enable",), ("read",)):
            with servobus(*verb, "--trace", SERVOBUS_SOCKET=there, SERVOBUS_CONFIG=str(other)) as process:
                out, err = process.communicate(timeout=30)
                assert (process.returncode, out) == (2, "")
                assert "which of the two is meant?" in err
                assert " > " not in err, "no frame left"
        with servobus("read", "--json", SERVOBUS_SOCKET=there, SERVOBUS_CONFIG="servobus.yaml") as process:
            assert set(json.loads(process.communicate(timeout=30)[0])) == {"arm/shoulder", "arm/elbow"}
        daemon.terminate()
        assert daemon.wait(10) == 0


@pytest.mark.slow
def test_every_verb_reaches_a_daemon_that_is_named_by_its_tcp_address(tmp_path: Path) -> None:
    token, config = tmp_path / "token", tmp_path / "tcp.yaml"
    token.write_text("x" * 40)
    token.chmod(0o600)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    config.write_text(LIMP + f"door: {{tcp: {{port: {port}, token_file: {token}, role: admin}}}}\n")
    there = f"tcp://127.0.0.1:{port}"
    with servobus("run", str(config), SERVOBUS_SOCKET=str(tmp_path / "d" / "s.sock")) as daemon:
        until(daemon, "running")
        for verb in (("enable",), ("move", "shoulder=5"), ("read",), ("stop",), ("clear",), ("disable",)):
            with servobus(*verb, "--json", SERVOBUS_SOCKET=there, SERVOBUS_TOKEN_FILE=str(token)) as process:
                out, err = process.communicate(timeout=30)
                assert process.returncode == 0, err
                assert json.loads(out)
                assert "daemon" not in err
        daemon.terminate()
        assert daemon.wait(10) == 0
