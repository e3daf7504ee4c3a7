"""The simulated arm: one bit for every failure, and what it reports of itself."""

from __future__ import annotations

from typing import Any

import pytest

from servobus.protocols.modbus.codec import ModbusCodec
from servobus.protocols.realman.codec import dialect
from servobus.protocols.realman.simulated.arm import DESCRIPTION, SimulatedArm
from servobus.protocols.roh.simulated.device import RohDevice
from tests.protocols.roh.bench import hand_of


def arm_of(generation: int = 3, hand: RohDevice | None = None) -> SimulatedArm:
    behind = hand or hand_of()

    def exchange(request: bytes) -> bytes | None:
        codec = ModbusCodec("device")
        codec.receive_data(request)
        frame = codec.next_reply()
        assert frame is not None
        replies = behind.handle(frame, 0.0)
        return replies[0].data if replies else None

    arm = SimulatedArm(exchange, generation)
    opened = arm.handle(dialect(generation, 1).open_mode(115_200, 0.1).message)
    assert opened is not None
    assert opened["set_state"]
    return arm


@pytest.mark.parametrize("generation", [2, 3, 4])
def test_registers_both_ways(generation: int) -> None:
    hand = hand_of()
    arm, say = arm_of(generation, hand), dialect(generation, 1)
    for command, registers in (
        (say.write(2, 1135, [100, 200]), []),
        (say.read(2, 1135, 2), [100, 200]),
        (say.write(2, 1126, [7]), []),
        (say.read(2, 1126, 1), [7]),
        (say.read(2, 1990, 1), None),
        (say.read(9, 1135, 1), None),
        (say.write(2, 1001, [7]), None),
    ):
        reply = arm.handle(command.message)
        assert reply is not None
        assert command.answers(reply)
        assert command.registers(reply) == registers


@pytest.mark.parametrize(
    ("generation", "message"),
    [
        (3, {"command": "read_multiple_holding_registers", "port": 1, "address": 1145, "num": 13, "device": 2}),
        (3, {"command": "read_holding_registers", "port": 0, "address": 1145, "device": 2}),
        (3, {"command": "read_holding_registers", "port": 1, "device": 2}),
        (3, {"command": "write_registers", "port": 1, "address": 1135, "num": 11, "data": [0] * 22, "device": 2}),
        (3, {"command": "write_registers", "port": 1, "address": 1135, "num": 2, "data": [0], "device": 2}),
        (4, {"command": "read_modbus_rtu_holding_registers", "type": 1, "address": 1020, "num": 101, "device": 2}),
    ],
)
def test_everything_that_fails_is_one_bit(generation: int, message: dict[str, Any]) -> None:
    reply = arm_of(generation).handle(message)
    assert reply is not None
    assert [value for key, value in reply.items() if key.endswith("_state")] == [False]


def test_each_generation_answers_only_its_own_commands() -> None:
    assert arm_of(4).handle(dialect(3, 1).read(2, 1000, 1).message) is None
    assert arm_of(3).handle(dialect(4, 1).read(2, 1000, 1).message) is None
    assert arm_of().handle({"command": 5}) is None


def test_it_describes_itself() -> None:
    arm = arm_of()
    assert all(arm.handle({"command": command}) == reply for command, reply in DESCRIPTION.items())
    assert (arm_of(2).handle({"command": "get_arm_software_info"})) is None
    assert (arm_of(2).handle({"command": "get_arm_software_version"}) or {})["state"] == "arm_software_version"
    newest = arm_of(4).handle({"command": "get_arm_software_info"})
    assert newest is not None
    assert newest["robot_controller_version"] == "4.0"


def test_modes_and_power() -> None:
    arm = arm_of()
    assert arm.modes == {1: 115_200}
    arm.handle({"command": "close_modbus_mode", "port": 1})
    assert arm.modes == {}
    arm.handle({"command": "set_tool_voltage", "voltage_type": 3})
    assert arm.voltage == 3
    arm.refuses_modes = True
    assert arm.handle(dialect(3, 1).open_mode(115_200, 0.1).message) == {"command": "set_modbus_mode", "set_state": False}
    four = arm_of(4)
    four.handle(dialect(4, 0).open_mode(9600, 0.1).message)
    assert four.modes == {1: 115_200, 0: 9600}
