"""Independent Modbus peers: mbpoll and pymodbus as masters of a simulated hand, pymodbus as a hand for our driver."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from pymodbus import FramerType
from pymodbus.client import ModbusSerialClient
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from servobus.config.loader import parse_config
from servobus.rig.local import open_rig
from servobus.values import Outcome
from tests.clients.bus_process import served

pytestmark = pytest.mark.slow

HAND = """\
version: 1
buses:
  arm:
    protocol: roh
    port: "sim:"
    baudrate: 115200
    servos: {index: {id: 2, channel: index}}
"""
TARGET, POSITION, SPEED, READ_ONLY, NOWHERE = 1136, 1146, 1126, 1001, 1990


@pytest.fixture
def port(tmp_path: Path) -> Iterator[str]:
    with served(tmp_path, HAND) as path:
        yield path


def mbpoll(port: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    line = ["mbpoll", "-m", "rtu", "-a", "2", "-b", "115200", "-P", "none", "-0", "-1", "-o", "2"]
    return subprocess.run([*line, *arguments], capture_output=True, text=True, check=False, timeout=20)


@pytest.mark.skipif(shutil.which("mbpoll") is None, reason="mbpoll is not installed (Debian: apt-get install mbpoll)")
def test_mbpoll(port: str) -> None:
    """mbpoll reads and writes registers, and its impossible requests are refused."""
    assert "[1000]: \t512" in mbpoll(port, "-r", "1000", port).stdout
    assert mbpoll(port, "-r", str(SPEED), port, "40000").returncode == 0
    assert mbpoll(port, "-r", "1185", port, "20", "21", "22").returncode == 0
    output = mbpoll(port, "-r", "1185", "-c", "3", port).stdout
    assert [f"[{1185 + at}]: \t{20 + at}" in output for at in range(3)] == [True] * 3
    assert "Illegal data address" in mbpoll(port, "-r", str(NOWHERE), port).stderr
    assert "Illegal data address" in mbpoll(port, "-r", str(READ_ONLY), port, "1").stderr


def test_pymodbus_is_served(port: str) -> None:
    client: Any = ModbusSerialClient(port, framer=FramerType.RTU, baudrate=115200, timeout=2)
    assert client.connect()
    try:
        assert client.read_holding_registers(1000, count=2, device_id=2).registers == [0x0200, 0x0301]
        assert not client.write_registers(TARGET, [65535], device_id=2).isError()
        assert not client.write_register(SPEED, 60000, device_id=2).isError()
        assert client.read_holding_registers(SPEED, count=1, device_id=2).registers == [60000]
        assert client.read_holding_registers(NOWHERE, count=1, device_id=2).exception_code == 2
        assert client.write_registers(READ_ONLY, [1], device_id=2).exception_code == 2
        positions = (client.read_holding_registers(POSITION, count=1, device_id=2).registers[0] for _ in range(2000))
        assert any(position == 65535 for position in positions), "the finger has closed"
    finally:
        client.close()


@asynccontextmanager
async def pymodbus_hand() -> AsyncIterator[int]:
    """Unit 2 with 2 000 registers, whose first ones are those of the map v2. Yields its port."""
    registers = [0] * 2000
    registers[1000:1004] = [0x0200, 0x0301, 7, 0x2001]
    device = SimDevice(2, simdata=[SimData(0, values=registers, datatype=DataType.REGISTERS)])
    server = ModbusTcpServer(device, framer=FramerType.RTU, address=("127.0.0.1", 0))
    await server.listen()
    endpoint: Any = server
    try:
        yield endpoint.transport.sockets[0].getsockname()[1]
    finally:
        await endpoint.shutdown()


async def test_pymodbus_as_the_hand() -> None:
    async with pymodbus_hand() as port:
        text = HAND.replace('"sim:"', f"tcp://127.0.0.1:{port}").replace("index: {id", "index: {limits: [0, 90], id")
        async with open_rig(parse_config(text, "peer")) as rig:
            identity = await rig.identify("index")
            assert (identity.model, identity.firmware) == ("v2", "3.1.7")
            await rig.enable()
            assert await rig["index"].move_to(60) is Outcome.ACKED
            assert await rig.read_register("index", f"{TARGET}:1") == [round(0.6 * 65535)]
            assert await rig.write_register("index", "stall_speed", 33) == 33
            assert (await rig.read("index")).position == 0, "a store of registers does not move"
