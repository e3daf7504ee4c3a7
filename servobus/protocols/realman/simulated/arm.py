"""A simulated RealMan arm: the device's end of the JSON lines, with any Modbus-RTU devices behind its ports. Sans-IO.

Where the documents are silent: an unknown command is not answered. A Modbus command before the mode was set, or beyond the arm's
register limits, fails like any other failure: one bit in the reply.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from servobus.protocols.modbus.codec import REFUSED, Function, ModbusCodec, encode, pack, unpack
from servobus.protocols.realman.codec import INFO, INFO_REPLY, TOOL, VERSION, VERSION_REPLY, Message

Exchange = Callable[[bytes], bytes | None]
"""Modbus-RTU request -> its reply; None: no unit answers."""
JOINTS = 6
BUILD = {"build_time": "2024/01/01 00:00:00", "commit_id": "0000000", "version": "V1.0.0"}


class SimulatedArm:
    """One arm of generation 2, 3 or 4."""

    def __init__(self, exchange: Exchange, generation: int = 3) -> None:
        self.generation = generation
        self.modes: dict[int, int] = {}
        """Port -> baud rate, of the ports that are a Modbus master."""
        self.voltage = 0
        """The arm's code of the supply at the tool."""
        self.refuses_modes = False
        self._exchange = exchange
        self._handlers: Mapping[str, Callable[[Message], Message | None]] = HANDLERS_4 if generation >= 4 else HANDLERS_3

    def handle(self, message: Message) -> Message | None:
        """Return the reply to one message; None where the arm does not answer."""
        command = message.get("command")
        if not isinstance(command, str):
            return None
        if command in self._handlers:
            try:
                return self._handlers[command](self, message)  # type: ignore[call-arg, arg-type]
            except (KeyError, TypeError, ValueError):
                return {"command": command, _result_key(command): False}
        return self._describe_itself(command)

    def _describe_itself(self, command: str) -> Message | None:
        if command == VERSION["command"]:
            return {"state": VERSION_REPLY, "Product_version": "RM65", "Plan_version": "v1.0.0"}
        if self.generation == 2 and command == INFO["command"]:
            return None
        if command == INFO["command"]:
            generation_4 = {"robot_controller_version": "4.0"} if self.generation >= 4 else {}
            return {
                "command": INFO_REPLY,
                "Product_version": "RM65-BI",
                "algorithm_info": {"version": "1.0.0"},
                "ctrl_info": BUILD,
                "dynamic_info": {"model_version": "1"},
                "plan_info": BUILD,
                **generation_4,
            }
        return DESCRIPTION.get(command)

    # Modes

    def set_voltage(self, message: Message) -> Message:
        self.voltage = int(message["voltage_type"])
        return {"command": message["command"], "state": True}

    def set_mode(self, message: Message) -> Message:
        if not self.refuses_modes:
            self.modes[int(message.get("port", TOOL))] = int(message["baudrate"])
        return {"command": message["command"], "set_state": not self.refuses_modes}

    def set_controller_mode(self, message: Message) -> Message:
        return self.set_mode({**message, "port": 0})

    def close_mode(self, message: Message) -> Message:
        self.modes.pop(int(message["port"]), None)
        return {"command": message["command"], "set_state": True}

    # Registers, generations 2 and 3

    def read_one(self, message: Message) -> Message:
        registers = self._read(message, int(message["port"]), 1)
        return self._read_reply(message, None if registers is None else registers[0])

    def read_several(self, message: Message) -> Message:
        count = int(message["num"])
        registers = self._read(message, int(message["port"]), count) if count <= 12 else None
        return self._read_reply(message, None if registers is None else list(pack(registers)))

    def write_one(self, message: Message) -> Message:
        return self._write(message, int(message["port"]), [int(message["data"])])

    def write_several(self, message: Message) -> Message:
        count = int(message["num"])
        values = unpack(bytes(message["data"]))
        if count > 10 or len(values) != count:
            raise ValueError
        return self._write(message, int(message["port"]), values)

    # Registers, generation 4

    def read_registers(self, message: Message) -> Message:
        count = int(message["num"])
        return self._read_reply(message, self._read(message, int(message["type"]), count) if count <= 100 else None)

    def write_registers(self, message: Message) -> Message:
        return self._write(message, int(message["type"]), [int(value) for value in message["data"]])

    # The line behind a port

    def _read(self, message: Message, port: int, count: int) -> list[int] | None:
        data = self._ask(message, port, Function.READ_HOLDING, pack((int(message["address"]), count)))
        return None if data is None else unpack(data[1:])

    def _write(self, message: Message, port: int, values: list[int]) -> Message:
        span = pack((int(message["address"]), len(values)))
        data = self._ask(message, port, Function.WRITE_MULTIPLE, span + bytes((2 * len(values),)) + pack(values))
        return {"command": message["command"], "write_state": data is not None}

    def _ask(self, message: Message, port: int, function: int, data: bytes) -> bytes | None:
        """Return the data of the Modbus reply; None for no reply, an exception, or a port that is not a Modbus master."""
        if port not in self.modes:
            return None
        answer = self._exchange(encode(int(message["device"]), function, data))
        codec = ModbusCodec("master")
        codec.receive_data(answer or b"")
        reply = codec.next_reply()
        return None if reply is None or reply.function & REFUSED else reply.data

    @staticmethod
    def _read_reply(message: Message, data: Any) -> Message:
        return {"command": message["command"], **({"read_state": False} if data is None else {"data": data})}


def _result_key(command: str) -> str:
    return "write_state" if command.startswith("write") else "read_state" if command.startswith("read") else "set_state"


SIX: list[int] = [0] * JOINTS
STATES: dict[str, dict[str, Any]] = {
    "arm_current_trajectory": {"type": "none", "data": SIX},
    "current_work_frame": {"frame_name": "World", "pose": SIX},
    "current_tool_frame": {"tool_name": "Arm_Tip", "pose": SIX, "payload": 0, "position": [0, 0, 0]},
    "install_pose": {"pose": [0, 0, 0]},
    "joint_min_pos": {"min_pos": [-178_000] * JOINTS},
    "joint_max_pos": {"max_pos": [178_000] * JOINTS},
    "joint_max_acc": {"joint_acc": [600_000] * JOINTS},
    "joint_max_speed": {"joint_speed": [180_000] * JOINTS},
}
PUSH = {"cycle": 5, "enable": False, "ip": "127.0.0.1", "port": 8089}
CUSTOM_PUSH = {"expand_state": False, "joint_speed": False, "lift_state": False}
DESCRIPTION: dict[str, Message] = {
    "get_realtime_push": {"command": "get_realtime_push", **PUSH, "custom": CUSTOM_PUSH},
    **{f"get_{state}": {"state": state, **fields} for state, fields in STATES.items()},
    "get_DH_data": {"command": "get_DH_data", **{f"joint_{number}": [0, 0, 0, 0] for number in range(1, JOINTS + 1)}},
}
"""Command -> reply, for what the vendor's client asks when it connects."""

HANDLERS_3: dict[str, Callable[..., Message]] = {
    "set_tool_voltage": SimulatedArm.set_voltage,
    "set_modbus_mode": SimulatedArm.set_mode,
    "close_modbus_mode": SimulatedArm.close_mode,
    "read_holding_registers": SimulatedArm.read_one,
    "read_multiple_holding_registers": SimulatedArm.read_several,
    "write_single_register": SimulatedArm.write_one,
    "write_registers": SimulatedArm.write_several,
}
HANDLERS_4: dict[str, Callable[..., Message]] = {
    "set_tool_voltage": SimulatedArm.set_voltage,
    "set_tool_rs485_mode": SimulatedArm.set_mode,
    "set_controller_rs485_mode": SimulatedArm.set_controller_mode,
    "read_modbus_rtu_holding_registers": SimulatedArm.read_registers,
    "write_modbus_rtu_registers": SimulatedArm.write_registers,
}
