"""A command that fails or is interrupted says which servos it leaves energised, and how; a second signal ends it at once."""

from __future__ import annotations

import json
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from tests.cli.processes import servobus, until

pytestmark = pytest.mark.slow
SERVOS = {
    "sts": "protocol: sms, baudrate: 1000000, servos: {{s1: {{id: 1, model: sts{keys}}}{more}}}",
    "sms_cl": "protocol: sms, baudrate: 115200, servos: {{s1: {{id: 1, model: sms_cl{keys}}}{more}}}",
    "kst": "protocol: kst, baudrate: 512000, servos: {{s1: {{id: 1{keys}}}{more}}}",
    "roh": "protocol: roh, baudrate: 115200, servos: {{s1: {{id: 2, channel: index{keys}}}{more}}}",
}
MORE = {"roh": ", s2: {id: 3, channel: index}"}
every_protocol = pytest.mark.parametrize("protocol", SERVOS)
SLOW = ("s1=80", "--speed", "2")
PARK = ", on_exit: park, park_pose: -80, park_timeout: 60, speed: 1"


def write_config(path: Path, protocol: str, port: str = "sim:", *, keys: str = "", more: str = "") -> str:
    bus = SERVOS[protocol].format(keys=keys, more=more)
    path.write_text(f'version: 1\nbuses:\n  arm: {{port: "{port}", {bus}}}\n')
    return str(path)


@contextmanager
def simulated(folder: Path, protocol: str) -> Iterator[str]:
    """The port of a line that outlives a command."""
    with servobus("sim", write_config(folder / "sim.yaml", protocol)) as sim:
        assert sim.stdout is not None
        yield sim.stdout.readline().split()[1]


def ended(*arguments: str) -> tuple[int, str, str]:
    with servobus(*arguments) as process:
        out, err = process.communicate(timeout=60)
        return process.returncode, out, err


def document(out: str) -> Any:
    """The one document on standard output."""
    assert out.count("\n") == 1
    return json.loads(out)


@every_protocol
def test_disable_calls_limp_only_what_is_limp(protocol: str, tmp_path: Path) -> None:
    """A KST servo and a finger have no torque command: disabled, they go on to hold."""
    config = write_config(tmp_path / "rig.yaml", protocol)
    limp = protocol in ("sts", "sms_cl")
    status, out, _ = ended("disable", "-c", config)
    assert (status, "limp" in out, "may still hold" in out) == (0, limp, not limp)
    status, out, _ = ended("disable", "-c", config, "--json")
    assert document(out) == {"arm/s1": {"enabled": False, "energised": False if limp else None}}


@every_protocol
def test_a_move_that_does_not_arrive_says_what_it_leaves(protocol: str, tmp_path: Path) -> None:
    config = write_config(tmp_path / "rig.yaml", protocol)
    status, out, err = ended("move", "-c", config, *SLOW, "--timeout", "0.3", "--json")
    assert status == 1
    assert err.splitlines()[-1].startswith("servobus: arm/s1: left: holds")
    answer = document(out)
    assert answer["error"]["type"] == "SettleTimeout"
    assert (answer["left"]["arm/s1"]["action"], answer["left"]["arm/s1"]["confirmed"]) == ("hold", True)


@pytest.mark.parametrize("protocol", ["sts", "sms_cl"])
def test_a_servo_that_goes_limp_is_said_to_be_limp(protocol: str, tmp_path: Path) -> None:
    config = write_config(tmp_path / "rig.yaml", protocol, keys=", on_exit: limp")
    status, _, err = ended("move", "-c", config, *SLOW, "--timeout", "0.3")
    assert status == 1
    assert "servobus: arm/s1: left: limp" in err


@every_protocol
def test_a_move_with_a_partner_that_is_gone_energises_nobody(protocol: str, tmp_path: Path) -> None:
    with simulated(tmp_path, protocol) as port:
        more = MORE.get(protocol, ", s2: {id: 9}" if protocol == "kst" else f", s2: {{id: 9, model: {protocol}}}")
        config = write_config(tmp_path / "rig.yaml", protocol, port, more=more)
        status, out, err = ended("move", "-c", config, "s1=5", "s2=5", "--json")
        assert status == 1
        assert "arm/s2" in err
        assert "left" not in err
        assert document(out)["left"] == {}
        _, out, _ = ended("read", "s1", "-c", config, "--json")
        assert not document(out)["arm/s1"]["energised"]


@pytest.mark.parametrize("protocol", ["sts", "sms_cl"])
def test_a_move_of_a_servo_in_velocity_mode_energises_nobody(protocol: str, tmp_path: Path) -> None:
    with simulated(tmp_path, protocol) as port:
        config = write_config(tmp_path / "rig.yaml", protocol, port)
        status, _, err = ended("write", "s1", "mode=1", "--persist", "-c", config)
        assert status == 0, err
        status, out, err = ended("move", "-c", config, "s1=5", "--trace", "--json")
        assert status == 2
        assert "WRITE 0x28 = 01" not in err
        assert document(out)["left"] == {}


@contextmanager
def moving(config: str, *options: str) -> Iterator[subprocess.Popen[str]]:
    """A motion that takes long, once its goal was sent."""
    with servobus("move", "-c", config, *SLOW, "--timeout", "100", "--trace", *options) as process:
        assert process.stderr is not None
        assert any("0x2A" in line and ">" in line for line in process.stderr)
        yield process


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 143)])
def test_an_interrupted_move_says_what_it_does_and_what_it_leaves(number: signal.Signals, status: int, tmp_path: Path) -> None:
    with moving(write_config(tmp_path / "rig.yaml", "sts"), "--json") as process:
        process.send_signal(number)
        out, err = process.communicate(timeout=20)
        assert process.returncode == status
        assert "servobus: interrupted: doing on_exit of arm/s1 (hold)" in err
        assert "servobus: arm/s1: left: holds" in err
        answer = document(out)
        assert answer["error"]["type"] == "Interrupted"
        assert answer["left"]["arm/s1"]["confirmed"]


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_the_second_signal_says_what_stays_energised_and_ends_at_once(
    number: signal.Signals, status: int, tmp_path: Path
) -> None:
    with moving(write_config(tmp_path / "rig.yaml", "sts", keys=PARK), "--json") as process:
        process.send_signal(number)
        assert process.stderr is not None
        assert any("interrupted: doing on_exit of arm/s1 (park)" in line for line in process.stderr)
        process.send_signal(number)
        out, err = process.communicate(timeout=20)
        assert process.returncode == status
        assert "servobus: left energised: arm/s1" in err
        answer = document(out)
        assert answer["left"]["arm/s1"]["confirmed"] is False


@pytest.mark.parametrize("pause_ms", [0, 5, 10, 20, 40, 80])
def test_a_second_ctrl_c_at_any_moment_is_an_interrupted_command(pause_ms: int, tmp_path: Path) -> None:
    with moving(write_config(tmp_path / "rig.yaml", "sts")) as process:
        process.send_signal(signal.SIGINT)
        assert process.stderr is not None
        assert any("interrupted" in line for line in process.stderr)
        with suppress(subprocess.TimeoutExpired):
            process.wait(pause_ms / 1000)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=20)
        assert process.returncode == 130
        assert "Traceback" not in err
        assert "arm/s1" in err


def test_a_daemon_keeps_what_a_failing_command_moved_and_the_command_says_so(tmp_path: Path) -> None:
    config = write_config(tmp_path / "rig.yaml", "sts")
    with servobus("run", config) as daemon:
        until(daemon, "running")
        assert ended("move", "s1=5")[2].count("energised") == 0
        assert ended("enable")[0] == 0
        status, out, err = ended("move", *SLOW, "--timeout", "0.3", "--json")
        assert status == 1
        assert "servobus: arm/s1: left: stays energised (the daemon keeps it" in err
        assert document(out)["left"]["arm/s1"]["action"] == "stays"
        daemon.terminate()
        assert until(daemon, "ending")["text"] == "interrupted: doing on_exit of arm/s1 (hold); interrupt again to end at once"
        assert daemon.wait(10) == 0


def test_a_move_that_an_e_stop_ends_does_not_say_that_a_limp_servo_stays_energised(tmp_path: Path) -> None:
    with servobus("run", write_config(tmp_path / "rig.yaml", "sts", keys=", on_estop: limp")) as daemon:
        until(daemon, "running")
        assert ended("enable")[0] == 0
        with servobus("move", *SLOW) as move:
            while '"moving":true' not in ended("read", "--json")[1].replace(" ", ""):
                assert move.poll() is None
            assert ended("stop")[0] == 0
            err = move.communicate(timeout=60)[1]
        assert move.returncode == 1
        assert "daemon keeps it" not in err
        assert "arm/s1: left: stays energised" not in err


def test_a_daemon_that_is_ended_twice_says_what_it_leaves(tmp_path: Path) -> None:
    with servobus("run", write_config(tmp_path / "rig.yaml", "sts", keys=PARK)) as daemon:
        until(daemon, "running")
        assert ended("enable")[0] == 0
        daemon.terminate()
        until(daemon, "ending")
        daemon.terminate()
        assert until(daemon, "ending")["text"] == "left energised: arm/s1"
        assert daemon.wait(10) == 143
