"""Commands as processes: run, sim, and others that a signal or a closed pipe ends."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import pytest

from tests.cli.processes import LIMP, servobus, until
from tests.config.mistakes import GOOD

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 0), (signal.SIGINT, 130)])
def test_run_ends_in_order(rig: str, number: signal.Signals, status: int) -> None:
    with servobus("run", rig, "--log-every", "0.2") as process:
        assert until(process, "running")["buses"] == ["arm"]
        state = until(process, "state")
        assert state["positions"] == {"shoulder": 0.0, "elbow": 0.0}
        process.send_signal(number)
        until(process, "ended")
        assert process.wait(10) == status


def test_run_waits_for_a_port(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(GOOD.replace('"sim:"', str(tmp_path / "port")))
    with servobus("run", str(path)) as process:
        assert "does not exist" in str(until(process, "waiting_for_port")["reason"])
        until(process, "running")
        process.terminate()
        assert process.wait(10) == 0


def test_a_world_writable_config_is_not_run(rig: str) -> None:
    os.chmod(rig, 0o666)
    with servobus("run", rig) as process:
        _, errors = process.communicate(timeout=20)
        assert process.returncode == 2
        assert "every user may write to it" in errors


def test_a_second_daemon_is_refused_with_the_pid_of_the_first(rig: str) -> None:
    with servobus("run", rig) as first:
        until(first, "running")
        with servobus("run", rig) as second:
            _, errors = second.communicate(timeout=20)
            assert second.returncode == 1
            assert f"daemon (pid {first.pid}) listens at" in errors
        first.terminate()
        assert first.wait(10) == 0


def test_a_reload_by_signal(rig: str) -> None:
    with servobus("run", rig) as process:
        until(process, "running")
        text = Path(rig).read_text()
        Path(rig).write_text(text.replace("id: 1", "id: 999"))
        process.send_signal(signal.SIGHUP)
        assert "found 999" in str(until(process, "reload_refused")["reason"])
        Path(rig).write_text(text.replace("id: 1", "id: 9"))
        process.send_signal(signal.SIGHUP)
        assert until(process, "reloaded")["changed"] == ["arm"]
        process.terminate()
        assert process.wait(10) == 0


def test_a_signal_never_opens_a_bus_again_whose_servo_is_enabled(rig: str) -> None:
    with servobus("run", rig) as process:
        until(process, "running")
        with servobus("enable", "elbow") as enabling:
            enabling.communicate(timeout=20)
        text = Path(rig).read_text()
        Path(rig).write_text(text.replace("feedback: 50", "feedback: 40"))
        process.send_signal(signal.SIGHUP)
        assert until(process, "reloaded")["updated"] == ["arm"]
        Path(rig).write_text(text.replace("id: 1", "id: 9"))
        process.send_signal(signal.SIGHUP)
        assert "opens again arm, while these servos are enabled or owe a stop: arm/elbow" in str(
            until(process, "reload_refused")["reason"]
        )
        with servobus("read", "elbow", "--json") as reading:
            assert json.loads(reading.communicate(timeout=20)[0])["arm/elbow"]["enabled"] is True
        process.terminate()
        assert process.wait(10) == 0


def test_clear_names_the_stops_that_are_owed(rig: str, tmp_path: Path) -> None:
    """The servos are deaf while their line stands still."""
    with servobus("sim", rig) as sim:
        assert sim.stdout is not None
        real = tmp_path / "real.yaml"
        real.write_text(LIMP.replace('"sim:"', sim.stdout.readline().split()[1]))
        with servobus("run", str(real)) as daemon:
            until(daemon, "running")
            with servobus("enable") as enabling:
                assert enabling.wait(20) == 0
            sim.send_signal(signal.SIGSTOP)
            with servobus("stop") as stopping:
                assert stopping.wait(20) == 1
            with servobus("clear", "--json") as clearing:
                out, _ = clearing.communicate(timeout=20)
                assert json.loads(out) == {"released": True, "owed": ["arm/shoulder", "arm/elbow"]}
            with servobus("clear") as clearing:
                assert "still owed: the stop of arm/shoulder, arm/elbow" in clearing.communicate(timeout=20)[1]
            sim.send_signal(signal.SIGCONT)
            until(daemon, "stop_paid")
            daemon.terminate()
            assert daemon.wait(10) == 0


def test_a_move_whose_daemon_was_killed_does_not_say_that_it_keeps_the_servo(rig: str) -> None:
    with servobus("run", rig) as daemon:
        until(daemon, "running")
        with servobus("enable") as enabling:
            assert enabling.wait(20) == 0
        with servobus("move", "shoulder=90", "--speed", "1", "--json") as moving:
            with servobus("monitor", "--json", "shoulder") as monitor:
                assert monitor.stdout is not None
                while json.loads(monitor.stdout.readline())["arm/shoulder"]["position"] < 0.2:
                    pass
            daemon.kill()
            out, err = moving.communicate(timeout=20)
        assert moving.returncode == 1
        assert "may have been applied" not in err
        left = json.loads(out)["left"]["arm/shoulder"]
        assert left["confirmed"] is False
        assert "the connection to the daemon is lost" in left["detail"]


def test_the_commands_talk_to_the_daemon(rig: str) -> None:
    """Enable, move, stop and clear by processes of their own, each without a config."""
    with servobus("run", rig) as daemon:
        until(daemon, "running")
        ended = []
        for command in (
            ("enable",),
            ("move", "shoulder=10"),
            ("stop",),
            ("move", "shoulder=0"),
            ("clear",),
            ("clear",),
            ("stats",),
        ):
            with servobus(*command) as process:
                out, err = process.communicate(timeout=20)
                ended.append((command[0], process.returncode))
                assert "not latched" not in out + err
        assert ended == [("enable", 0), ("move", 0), ("stop", 0), ("move", 1), ("clear", 0), ("clear", 0), ("stats", 0)]
        daemon.terminate()
        assert daemon.wait(10) == 0


def test_a_simulator_and_a_daemon_on_its_port(rig: str, tmp_path: Path) -> None:
    with servobus("sim", rig, "--folder", str(tmp_path / "ports")) as sim:
        assert sim.stdout is not None
        name, path = sim.stdout.readline().split()
        assert (name, path) == ("arm", str(tmp_path / "ports" / "arm"))
        real = tmp_path / "real.yaml"
        real.write_text(LIMP.replace('"sim:"', path))
        with servobus("run", str(real)) as daemon:
            until(daemon, "running")
            with servobus("read", "-c", str(real)) as client:
                output, _ = client.communicate(timeout=20)
                assert client.returncode == 0
                assert "shoulder" in output, "the daemon answered"
            with servobus("read", "-c", str(real), "--direct") as second:
                _, errors = second.communicate(timeout=20)
                assert second.returncode == 1
                assert f"process {daemon.pid}" in errors
                assert f"the servobus daemon (pid {daemon.pid}) owns it: leave --direct out" in errors
            sim.kill()
            assert until(daemon, "line_down")["bus"] == "arm"
            daemon.terminate()
            assert daemon.wait(10) == 0


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 0), (signal.SIGINT, 130)])
def test_sim_prints_its_ports_and_nothing_else(rig: str, number: signal.Signals, status: int) -> None:
    with servobus("sim", rig) as process:
        assert process.stdout is not None
        name, path = process.stdout.readline().split()
        assert name == "arm"
        assert os.path.exists(path)
        process.send_signal(number)
        out, err = process.communicate(timeout=10)
        assert (out, err.strip(), process.returncode) == ("", "", status)


def test_an_interrupted_scan_prints_its_hits(rig: str) -> None:
    with servobus("scan", "-c", rig, "--baudrate", "9600,1000000", "--json", "--trace") as process:
        assert process.stderr is not None
        for line in process.stderr:
            if "id 9 PING" in line:
                break
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=20)
        assert process.returncode == 130
        assert isinstance(json.loads(out), list)


def test_a_closed_pipe_ends_a_command_silently() -> None:
    with servobus("schema") as process:
        assert process.stdout is not None
        process.stdout.close()
        assert process.stderr is not None
        assert process.stderr.read() == ""
        assert process.wait(10) == 1


@pytest.mark.parametrize(("number", "status"), [(signal.SIGHUP, 143), (signal.SIGINT, 130)])
def test_an_interrupted_move_applies_on_exit(rig: str, number: signal.Signals, status: int) -> None:
    with servobus("move", "-c", rig, "shoulder=80", "--speed", "1", "--timeout", "100", "--trace") as process:
        assert process.stderr is not None
        torque_on = "WRITE 0x28 = 01"
        assert any(torque_on in line for line in process.stderr)
        process.send_signal(number)
        out, err = process.communicate(timeout=20)
        assert process.returncode == status
        assert "SYNC_WRITE 0x28 id 1 = 00" in err
        assert out == ""


def test_a_closed_trace_does_not_stop_a_motion(rig: str) -> None:
    with servobus("move", "-c", rig, "shoulder=5", "--speed", "300", "--trace") as process:
        assert process.stderr is not None
        process.stderr.readline()
        process.stderr.close()
        assert process.stdout is not None
        assert "arm/shoulder" in process.stdout.read()
        assert process.wait(10) == 0


def test_closed_logs_do_not_stop_a_daemon(rig: str) -> None:
    with servobus("run", rig, "--log-every", "0.1") as process:
        until(process, "state")
        assert process.stderr is not None
        process.stderr.close()
        process.terminate()
        assert process.wait(10) == 0


def test_a_closed_pipe_ends_the_monitor(rig: str) -> None:
    with servobus("monitor", "-c", rig, "--hz", "50") as process:
        assert process.stdout is not None
        process.stdout.readline()
        process.stdout.close()
        assert process.wait(10) == 1
        assert process.stderr is not None
        assert process.stderr.read() == ""


def test_a_scan_whose_line_is_lost_prints_its_hits(rig: str, tmp_path: Path) -> None:
    with servobus("sim", rig) as sim:
        assert sim.stdout is not None
        path = sim.stdout.readline().split()[1]
        with servobus("scan", "--port", path, "--baudrate", "1000000", "--json", "--trace") as scan:
            assert scan.stderr is not None
            assert any("id 9 PING" in line for line in scan.stderr)
            sim.kill()
            out, err = scan.communicate(timeout=20)
            assert scan.returncode == 1
            assert [hit["id"] for hit in json.loads(out)] == [1, 2]
            assert "servobus: line: " in err
