"""The programs of docs/python.md that SIGTERM ends do the `on_exit` of their servos."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cli.processes import LIMP, servobus
from tests.docs.blocks import blocks

PROGRAMS = [text for text in blocks("docs/python.md", "python") if "SIGTERM" in text]
MOVE = "move_to(30)\n"


def test_both_kinds_of_program_are_shown() -> None:
    assert [("servobus.open" in text, "blocking.open" in text) for text in PROGRAMS] == [(True, False), (False, True)]


@pytest.mark.slow
@pytest.mark.parametrize("program", PROGRAMS, ids=["asyncio", "blocking"])
def test_sigterm_leaves_the_servos_in_order(program: str, tmp_path: Path) -> None:
    config, real = tmp_path / "rig.yaml", tmp_path / "real.yaml"
    config.write_text(LIMP.replace("elbow: {id: 2,", "elbow: {id: 2, on_exit: limp,"))
    with servobus("sim", str(config)) as sim:
        assert sim.stdout is not None
        real.write_text(config.read_text().replace('"sim:"', sim.stdout.readline().split()[1]))
        assert MOVE in program
        text = program.replace("config/sim.yaml", str(real)).replace(MOVE, 'move_to(80, speed=2); print("moving", flush=True)\n')
        with subprocess.Popen([sys.executable, "-c", text], stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "moving\n"
            process.send_signal(signal.SIGTERM)
            assert process.wait(20) in (0, 143)
        assert [torque(real, name) for name in ("shoulder", "elbow")] == ["0", "0"]


def torque(config: Path, servo: str) -> str:
    with servobus("read", servo, "torque_enable", "--raw", "-c", str(config)) as process:
        out, err = process.communicate(timeout=30)
        assert process.returncode == 0, err
        return out.strip()
