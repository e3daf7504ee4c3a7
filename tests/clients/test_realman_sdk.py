"""The arm vendor's own client against `servobus sim`; its wheel has a library for Linux on x86-64."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from tests.clients.bus_process import served

pytestmark = pytest.mark.slow

sdk: Any = pytest.importorskip("Robotic_Arm.rm_robot_interface", reason="the vendor's Robotic_Arm is not installed")

HAND = """\
version: 1
buses:
  arm:
    protocol: roh
    port: "realman://127.0.0.1:1?port=1"
    servos: {index: {id: 2, channel: index}}
"""


def test_it_connects_reads_and_writes(tmp_path: Path) -> None:
    with served(tmp_path, HAND) as address:
        robot = sdk.RoboticArm(sdk.rm_thread_mode_e.RM_TRIPLE_MODE_E)
        try:
            handle = robot.rm_create_robot_arm("127.0.0.1", urlsplit(address).port)
            assert handle.id == 1
            assert robot.rm_set_modbus_mode(1, 115200, 2) == 0
            one = sdk.rm_peripheral_read_write_params_t(1, 1000, 2)
            assert robot.rm_read_holding_registers(one) == (0, 0x0200)
            six = sdk.rm_peripheral_read_write_params_t(1, 1135, 2, 6)
            assert robot.rm_write_registers(six, [0, 0] * 5 + [255, 255]) == 0
            assert robot.rm_read_multiple_holding_registers(six) == (0, [0, 0] * 5 + [255, 255])
            assert robot.rm_read_holding_registers(sdk.rm_peripheral_read_write_params_t(1, 1990, 2))[0] == 1
        finally:
            robot.rm_delete_robot_arm()
