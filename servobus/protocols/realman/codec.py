r"""JSON lines of RealMan arms, both ends (ROH seed 2; the arm's own pages): one object a line, ended by \r\n. Sans-IO.

A reply names the command it answers and nothing else, so two questions of one look (command and number of values) have answers
that can be mistaken for each other; `Step.look` is what a link compares. Generations 2 and 3 share their commands, 4 has others.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

END = b"\r\n"
MAX_LINE = 16_384
"""Bytes of a line; the longest an arm is known to say have about 1 KiB."""
WORD = range(-0x8000, 0x10000)
"""What may stand for a register: generation 3 also says them signed."""
CONTROLLER, TOOL = 0, 1
"""Ports: the controller's RS485, the one at the end of the arm."""
VOLTAGES = {0: 0, 5: 1, 12: 2, 24: 3}
"""Volts at the tool -> the arm's code."""

Message = Mapping[str, Any]


def encode(message: Message) -> bytes:
    return json.dumps(message, separators=(",", ":"), allow_nan=False).encode() + END


class Lines:
    """Finds objects in a stream. What is no whole line of one object is skipped and counted; memory is bounded."""

    def __init__(self) -> None:
        self._buffer = b""
        self._dropping = False
        self.skipped = 0
        """Lines that were no object."""

    @property
    def pending(self) -> int:
        """Bytes of a line that is not ended yet."""
        return len(self._buffer)

    def feed(self, data: bytes) -> list[Message]:
        found = []
        *lines, self._buffer = (self._buffer + data).split(b"\n")
        for line in lines:
            message = None if self._dropping else _object(line)
            self._dropping = False
            if message is None:
                self.skipped += 1
            else:
                found.append(message)
        if len(self._buffer) > MAX_LINE:
            self._buffer, self._dropping = b"", True
        return found


def _object(line: bytes) -> Message | None:
    if not line.endswith(b"\r"):
        return None
    try:
        message = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return message if isinstance(message, dict) else None


@dataclass(frozen=True, slots=True)
class Step:
    """One command and what answers it."""

    message: Message
    answer: str
    """The `command` of its reply."""
    state: str
    """The key that says whether it was done."""
    values: int = 0
    """Numbers in `data` of a reply that says so."""
    pairs: bool = False
    """They are bytes, high before low."""

    @property
    def look(self) -> tuple[str, int]:
        return self.answer, self.values

    def answers(self, reply: Message) -> bool:
        """Whether this reply can be the answer: of that command, and either a no or the right number of values."""
        if reply.get("command") != self.answer:
            return False
        if reply.get(self.state) is False:
            return True
        if not self.values:
            return reply.get(self.state) is True
        return self._words(reply) is not None

    def words(self, reply: Message) -> list[int] | None:
        """Registers of a reply that answers; None: the arm says that it failed."""
        if reply.get(self.state) is False:
            return None
        return self._words(reply) if self.values else []

    def _words(self, reply: Message) -> list[int] | None:
        data = reply.get("data")
        numbers: list[int] = data if isinstance(data, list) else [data]  # type: ignore[list-item]  # looked at below
        if len(numbers) != self.values or not all(type(number) is int for number in numbers):
            return None
        if self.pairs:
            if not all(0 <= number <= 0xFF for number in numbers):
                return None
            return [numbers[at] << 8 | numbers[at + 1] for at in range(0, len(numbers), 2)]
        return [number & 0xFFFF for number in numbers] if all(number in WORD for number in numbers) else None


@dataclass(frozen=True, slots=True)
class Dialect:
    """The commands of generations 2 and 3."""

    generation: int
    port: int = TOOL
    max_read: int = 12
    max_write: int = 10

    def open_mode(self, baudrate: int, timeout: float) -> Step:
        """Modbus master on the port. `timeout`: seconds the arm waits for the hand, in steps of 0.1."""
        tenths = max(1, round(10 * timeout))
        message = {"command": "set_modbus_mode", "port": self.port, "baudrate": baudrate, "timeout": tenths}
        return Step(message, "set_modbus_mode", "set_state")

    def close_mode(self) -> Step | None:
        return Step({"command": "close_modbus_mode", "port": self.port}, "close_modbus_mode", "set_state")

    def read(self, unit: int, address: int, count: int) -> Step:
        message: dict[str, Any] = {"port": self.port, "address": address, "device": unit}
        if count == 1:
            return Step({"command": "read_holding_registers", **message}, "read_holding_registers", "read_state", 1)
        command = "read_multiple_holding_registers"
        message = {"command": command, "port": self.port, "address": address, "num": count, "device": unit}
        return Step(message, command, "read_state", 2 * count, pairs=True)

    def write(self, unit: int, address: int, values: Sequence[int]) -> Step:
        if len(values) == 1:
            message: dict[str, Any] = {"port": self.port, "address": address, "data": values[0], "device": unit}
            return Step({"command": "write_single_register", **message}, "write_single_register", "write_state")
        data = [byte for value in values for byte in divmod(value, 256)]
        message = {"port": self.port, "address": address, "num": len(values), "data": data, "device": unit}
        return Step({"command": "write_registers", **message}, "write_registers", "write_state")


@dataclass(frozen=True, slots=True)
class Dialect4(Dialect):
    """Those of generation 4: words instead of bytes, one read and one write."""

    max_read: int = 100
    max_write: int = 100

    def open_mode(self, baudrate: int, timeout: float) -> Step:
        command = "set_tool_rs485_mode" if self.port == TOOL else "set_controller_rs485_mode"
        return Step({"command": command, "mode": 0, "baudrate": baudrate}, command, "set_state")

    def close_mode(self) -> None:
        """There is none: a mode is changed for another one only."""

    def read(self, unit: int, address: int, count: int) -> Step:
        command = "read_modbus_rtu_holding_registers"
        message = {"command": command, "address": address, "device": unit, "num": count, "type": self.port}
        return Step(message, command, "read_state", count)

    def write(self, unit: int, address: int, values: Sequence[int]) -> Step:
        command = "write_modbus_rtu_registers"
        message = {"command": command, "address": address, "device": unit, "type": self.port, "data": list(values)}
        return Step(message, command, "write_state")


def dialect(generation: int, port: int) -> Dialect:
    return Dialect4(generation, port) if generation >= 4 else Dialect(generation, port)


WHO = {"command": "get_arm_software_info"}
"""Generations 3 and 4 answer it. Its answer cannot be taken for any other: it is the fence, too."""
WHO_ANSWER = "arm_software_info"
WHO_2 = {"command": "get_arm_software_version"}
"""Generation 2 answers this one only."""
WHO_2_ANSWER = "arm_software_version"


def generation_of(reply: Message) -> int | None:
    """Of an answer to WHO or WHO_2; None: it is none."""
    if reply.get("state") == WHO_2_ANSWER or reply.get("command") == WHO_2_ANSWER:
        return 2
    if reply.get("command") not in (WHO_ANSWER, WHO["command"]):
        return None
    version = reply.get("robot_controller_version")
    return 4 if isinstance(version, str) and version.startswith("4") else 3


def is_fence(reply: Message) -> bool:
    return generation_of(reply) is not None


def set_voltage(volts: int) -> Step:
    """At the tool; a hand needs 24."""
    return Step({"command": "set_tool_voltage", "voltage_type": VOLTAGES[volts]}, "set_tool_voltage", "state")
