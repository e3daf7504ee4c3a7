"""What the command line does with a FEETECH servo in a state that another program has left it in. Served behind a PTY."""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import pytest

from servobus.config.loader import parse_config
from servobus.protocols.sms.codec import Instruction, encode
from servobus.protocols.sms.simulated.device import SmsDevice
from servobus.simulation.link import far_end, simulated_line
from servobus.simulation.pty import SimulatedPty
from tests.protocols.sms.single_servo import packet_of
from tests.protocols.sms.states import put, set_mode

pytestmark = pytest.mark.slow

TWO = ("s1: {id: 1, model: sts}", "s2: {id: 2, model: sts}")


@dataclass
class Line:
    """Simulated servos behind a PTY, and a config for them."""

    devices: dict[int, SmsDevice]
    path: Path

    async def run(self, verb: str, *arguments: str) -> tuple[int, Any, str]:
        """Run a command; its exit status, the JSON that it printed, and what it printed as text."""
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "servobus", verb, "-c", str(self.path), "--json", *arguments),
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )
        out, err = await process.communicate()
        assert process.returncode is not None
        return process.returncode, json.loads(out) if out else None, (out + err).decode()

    def position(self, node: int = 1) -> float:
        device = self.devices[node]
        device.joint.advance(asyncio.get_running_loop().time())
        return device.joint.position

    def arm(self, node: int) -> None:
        """A program is killed between its REG WRITE and its ACTION."""
        device = self.devices[node]
        device.handle(packet_of(encode(node, Instruction.REG_WRITE, b"\x2a\x00\x02")), asyncio.get_running_loop().time())


@asynccontextmanager
async def line_of(tmp_path: Path, *servos: str) -> AsyncIterator[Line]:
    text = "\n".join(
        [
            *("version: 1", "buses:", "  arm:", "    protocol: sms", "    port: 'PORT'", "    baudrate: 1000000"),
            *("    servos:", *(f"      {servo}" for servo in servos or TWO), ""),
        ]
    )
    setup = parse_config(text.replace("PORT", "sim:"), "test", Path())
    options, models, loop = setup.buses["arm"], setup.models["arm"], asyncio.get_running_loop()
    with closing(simulated_line(options, models, loop)) as line, closing(SimulatedPty(far_end(options, line, loop), loop)) as pty:
        path = tmp_path / "rig.yaml"
        path.write_text(text.replace("PORT", pty.path))
        yield Line({device.node: cast("SmsDevice", device) for device in line.devices}, path)


async def test_enable_of_a_joint_outside_its_stored_limits_is_refused_and_says_where_it_is(tmp_path: Path) -> None:
    async with line_of(tmp_path) as line:
        put(line.devices[1], "min_angle_limit", 2560)
        put(line.devices[1], "max_angle_limit", 3072)
        status, _, text = await line.run("enable", "s1")
        assert status != 0
        assert "the joint is at 0, outside the servo's own stored limits 45 to 90" in text
        assert (line.position(), line.devices[1].get("torque_enable")) == (2048, 0)


@pytest.mark.parametrize("mode", ["pwm", "step"])
async def test_a_mode_that_takes_no_goals_is_refused_by_move_and_stopped_by_its_own_rule(tmp_path: Path, mode: str) -> None:
    async with line_of(tmp_path) as line:
        device = line.devices[1]
        set_mode(device, mode)
        status, _, text = await line.run("move", "s1=10")
        assert status != 0
        assert f"it is in {mode} mode" in text
        now = asyncio.get_running_loop().time()
        put(device, "goal_speed", 50, now)
        put(device, "goal_time" if mode == "pwm" else "goal_position", 100 if mode == "pwm" else 3000, now)
        put(device, "torque_enable", 1, now)
        status, reports, text = await line.run("stop")
        assert status == 0, text
        assert reports["arm/s1"]["confirmed"]
        before = line.position()
        await asyncio.sleep(0.2)
        assert line.position() == before


async def test_30_degrees_a_second_are_30_where_a_count_of_speed_is_50_steps(tmp_path: Path) -> None:
    async with line_of(tmp_path) as line:
        put(line.devices[1], "phase", 8)
        status, _, text = await line.run("move", "s1=3", "--speed", "30")
        assert status == 0, text
        assert line.devices[1].get("goal_speed") == 7


@pytest.mark.parametrize(
    ("identity", "message"),
    [((0, 10, 5), "no model knows it: it reports END 0 and version 10/5"), ((1, 9, 35), "(model scs), the config says sts")],
)
async def test_a_servo_of_another_family_is_not_moved_and_status_says_so(
    tmp_path: Path, identity: tuple[int, int, int], message: str
) -> None:
    async with line_of(tmp_path) as line:
        line.devices[1].pose_as(*identity)
        status, _, text = await line.run("move", "s1=10")
        assert status != 0
        assert message in text
        assert (line.position(), line.devices[1].get("torque_enable")) == (2048, 0)


async def test_a_reg_write_of_a_killed_program_is_not_fired_by_a_confirmed_move_of_others(tmp_path: Path) -> None:
    async with line_of(tmp_path, *TWO, "s3: {id: 3, model: sts}") as line:
        line.arm(3)
        status, _, text = await line.run("move", "s1=3", "s2=3", "--confirm")
        assert status != 0
        assert "s3 holds an older REG WRITE" in text
        assert [line.position(node) for node in (1, 2, 3)] == [2048, 2048, 2048]
        assert (await line.run("disable", "s3"))[0] == 0
        status, _, text = await line.run("move", "s1=3", "s2=3", "--confirm")
        assert status == 0, text
        assert line.position(3) == 2048


async def test_stored_limits_of_a_turned_joint_are_read_and_written_in_its_order(tmp_path: Path) -> None:
    async with line_of(tmp_path, "s1: {id: 1, model: sts, direction: -1}") as line:
        assert (await line.run("write", "--persist", "s1", "min_angle_limit=-45"))[0] == 0
        assert (await line.run("write", "--persist", "s1", "max_angle_limit=90"))[0] == 0
        device = line.devices[1]
        assert (device.get("min_angle_limit"), device.get("max_angle_limit")) == (1024, 2560)
