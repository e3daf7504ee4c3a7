r"""The JSON lines of a RealMan arm, for both ends (RealMan JSON). Sans-IO.

One JSON object a line, ended by \r\n. A reply names the command that it answers and nothing else. So two commands with the same
`ArmCommand.reply_key` (command name and number of values) have replies that can be confused; a link compares these keys.
Generations 2 and 3 share their commands; generation 4 has others.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

END = b"\r\n"
MAX_LINE = 16_384
"""Bytes of a line; the longest that is documented has about 1 KiB."""
REGISTER_VALUES = range(-0x8000, 0x10000)
"""Numbers that can be a register: generation 3 also sends them signed."""
CONTROLLER, TOOL = 0, 1
"""Ports: the controller's RS485, and the one at the end of the arm."""
VOLTAGES = {0: 0, 5: 1, 12: 2, 24: 3}
"""Volts at the tool -> the arm's code."""

Message = Mapping[str, Any]


def encode(message: Message) -> bytes:
    """Return the bytes of one line."""
    return json.dumps(message, separators=(",", ":"), allow_nan=False).encode() + END


class JsonLines:
    """Finds JSON objects in a stream. Skips and counts lines that are not one object; its memory is bounded."""

    def __init__(self) -> None:
        self._buffer = b""
        self._dropping = False
        self.skipped = 0
        """Lines that were not an object."""

    @property
    def pending(self) -> int:
        """Bytes of a line that has not ended yet."""
        return len(self._buffer)

    def feed(self, data: bytes) -> list[Message]:
        """Take bytes, and return the objects that are complete now."""
        messages = []
        *lines, self._buffer = (self._buffer + data).split(b"\n")
        for line in lines:
            message = None if self._dropping else _object(line)
            self._dropping = False
            if message is None:
                self.skipped += 1
            else:
                messages.append(message)
        if len(self._buffer) > MAX_LINE:
            self._buffer, self._dropping = b"", True
        return messages


def _object(line: bytes) -> Message | None:
    if not line.endswith(b"\r"):
        return None
    try:
        message = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return message if isinstance(message, dict) else None


@dataclass(frozen=True, slots=True)
class ArmCommand:
    """One command to the arm, and what its reply looks like."""

    message: Message
    reply_name: str
    """The `command` of its reply."""
    result_key: str
    """The key of the reply that is true or false: whether the command was carried out."""
    values: int = 0
    """Numbers in `data` of a reply to a read."""
    pairs: bool = False
    """The numbers are bytes, high byte before low byte."""

    @property
    def reply_key(self) -> tuple[str, int]:
        """Commands with the same key have replies that can be confused."""
        return self.reply_name, self.values

    def answers(self, reply: Message) -> bool:
        """Return whether a reply can belong to this command: it reports a failure, or brings the right number of values."""
        if reply.get("command") != self.reply_name:
            return False
        if reply.get(self.result_key) is False:
            return True
        if not self.values:
            return reply.get(self.result_key) is True
        return self._parse_values(reply) is not None

    def registers(self, reply: Message) -> list[int] | None:
        """Return the registers in a reply for which `answers` is true. None: the arm reports a failure."""
        if reply.get(self.result_key) is False:
            return None
        return self._parse_values(reply) if self.values else []

    def _parse_values(self, reply: Message) -> list[int] | None:
        data = reply.get("data")
        numbers: list[int] = data if isinstance(data, list) else [data]  # type: ignore[list-item]  # checked in the next line
        if len(numbers) != self.values or not all(type(number) is int for number in numbers):
            return None
        if self.pairs:
            if not all(0 <= number <= 0xFF for number in numbers):
                return None
            return [numbers[at] << 8 | numbers[at + 1] for at in range(0, len(numbers), 2)]
        return [number & 0xFFFF for number in numbers] if all(number in REGISTER_VALUES for number in numbers) else None


@dataclass(frozen=True, slots=True)
class Dialect:
    """The commands of generations 2 and 3. `max_read` and `max_write`: registers of one command."""

    generation: int
    port: int = TOOL
    max_read: int = 12
    max_write: int = 10

    def open_mode(self, baudrate: int, timeout: float) -> ArmCommand:
        """Make the port a Modbus master. `timeout`: seconds that the arm waits for the hand, in steps of 0.1."""
        tenths = max(1, round(10 * timeout))
        message = {"command": "set_modbus_mode", "port": self.port, "baudrate": baudrate, "timeout": tenths}
        return ArmCommand(message, "set_modbus_mode", "set_state")

    def close_mode(self) -> ArmCommand | None:
        """Give the port back to the arm. None: this generation has no command for it."""
        return ArmCommand({"command": "close_modbus_mode", "port": self.port}, "close_modbus_mode", "set_state")

    def read(self, unit: int, address: int, count: int) -> ArmCommand:
        """Read holding registers."""
        message: dict[str, Any] = {"port": self.port, "address": address, "device": unit}
        if count == 1:
            return ArmCommand({"command": "read_holding_registers", **message}, "read_holding_registers", "read_state", 1)
        command = "read_multiple_holding_registers"
        message = {"command": command, "port": self.port, "address": address, "num": count, "device": unit}
        return ArmCommand(message, command, "read_state", 2 * count, pairs=True)

    def write(self, unit: int, address: int, values: Sequence[int]) -> ArmCommand:
        """Write holding registers."""
        if len(values) == 1:
            message: dict[str, Any] = {"port": self.port, "address": address, "data": values[0], "device": unit}
            return ArmCommand({"command": "write_single_register", **message}, "write_single_register", "write_state")
        data = [byte for value in values for byte in divmod(value, 256)]
        message = {"port": self.port, "address": address, "num": len(values), "data": data, "device": unit}
        return ArmCommand({"command": "write_registers", **message}, "write_registers", "write_state")


@dataclass(frozen=True, slots=True)
class Dialect4(Dialect):
    """The commands of generation 4: 16-bit numbers instead of bytes, one read and one write."""

    max_read: int = 100
    max_write: int = 100

    def open_mode(self, baudrate: int, timeout: float) -> ArmCommand:
        command = "set_tool_rs485_mode" if self.port == TOOL else "set_controller_rs485_mode"
        return ArmCommand({"command": command, "mode": 0, "baudrate": baudrate}, command, "set_state")

    def close_mode(self) -> None:
        """Return None: a mode can only be replaced by another one."""

    def read(self, unit: int, address: int, count: int) -> ArmCommand:
        command = "read_modbus_rtu_holding_registers"
        message = {"command": command, "address": address, "device": unit, "num": count, "type": self.port}
        return ArmCommand(message, command, "read_state", count)

    def write(self, unit: int, address: int, values: Sequence[int]) -> ArmCommand:
        command = "write_modbus_rtu_registers"
        message = {"command": command, "address": address, "device": unit, "type": self.port, "data": list(values)}
        return ArmCommand(message, command, "write_state")


def dialect(generation: int, port: int) -> Dialect:
    """Return the commands of an arm's generation, for one of its ports."""
    return Dialect4(generation, port) if generation >= 4 else Dialect(generation, port)


INFO = {"command": "get_arm_software_info"}
"""Generations 3 and 4 answer it. Its reply cannot be confused with any other, so it also serves as the fence."""
INFO_REPLY = "arm_software_info"
VERSION = {"command": "get_arm_software_version"}
"""The question that generation 2 answers."""
VERSION_REPLY = "arm_software_version"


def generation_of(reply: Message) -> int | None:
    """Return the arm's generation from a reply to INFO or VERSION; None for another reply."""
    if reply.get("state") == VERSION_REPLY or reply.get("command") == VERSION_REPLY:
        return 2
    if reply.get("command") not in (INFO_REPLY, INFO["command"]):
        return None
    version = reply.get("robot_controller_version")
    return 4 if isinstance(version, str) and version.startswith("4") else 3


def is_fence(reply: Message) -> bool:
    """Return whether this is the reply to the fence."""
    return generation_of(reply) is not None


def set_voltage(volts: int) -> ArmCommand:
    """Switch the supply at the tool; a hand needs 24 V."""
    return ArmCommand({"command": "set_tool_voltage", "voltage_type": VOLTAGES[volts]}, "set_tool_voltage", "state")
