"""Far ends whose every reply is different and names the request that it answers, so that a wrong value cannot pass for right.

A reply carries a number that counts up. The oracle remembers under that number which request it answered, of which node and when.
A value is right when it answers the request of its caller, and no earlier one. There is one oracle for each protocol.
"""

from __future__ import annotations

import asyncio
import random
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from servobus.bus.service import BusService
from servobus.config.loader import parse_config
from servobus.links.base import Link
from servobus.links.faulty import FaultyEnd
from servobus.links.memory import MemoryLink
from servobus.protocols.base import LineTraits
from servobus.protocols.kst.codec import Command, KstCodec
from servobus.protocols.kst.codec import encode as kst_encode
from servobus.protocols.modbus.codec import Function, ModbusCodec, pack, unpack
from servobus.protocols.modbus.codec import encode as modbus_encode
from servobus.protocols.options import FaultOptions
from servobus.protocols.registry import PROTOCOLS
from servobus.protocols.sms.codec import Instruction, SmsCodec
from servobus.protocols.sms.codec import encode as sms_encode

SERVOS = 10
NUMBERS = 1 << 16


@dataclass(frozen=True, slots=True)
class Question:
    """A request that was answered."""

    node: int
    subject: Any
    """What was read."""
    received_at: float


class Oracle(ABC):
    """A far end of ten servos."""

    head: str
    """The config of its bus, up to the servos."""
    servo: str
    """More keys of each servo."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._deliver: Callable[[bytes], object] = bytes
        self._questions: list[Question | None] = [None] * NUMBERS
        self._count = 0

    def attach(self, deliver: Callable[[bytes], None]) -> None:
        self._deliver = deliver

    def set_baudrate(self, baudrate: int) -> None:  # noqa: B027 - an oracle receives at every rate
        """Do nothing: an oracle has no rate."""

    def receive(self, data: bytes) -> None:
        reply = self.answer(data)
        if reply is not None:
            self._loop.call_soon(self._deliver, reply)

    @abstractmethod
    def answer(self, frame: bytes) -> bytes | None:
        """Return the reply to one whole frame."""

    @abstractmethod
    def register(self, rng: random.Random) -> str:
        """Return the name of something to read."""

    @abstractmethod
    def right(self, value: Any, node: int, register: str, asked: float) -> bool:
        """Return whether the value answers a request for that register of that node, sent at `asked` or later."""

    @abstractmethod
    def rename(self, frame: bytes, rng: random.Random) -> bytes:
        """Return the same reply in the name of the next servo, which exists."""

    def _number(self, node: int, subject: Any, numbers: int = NUMBERS) -> int:
        self._count = number = (self._count + 1) % numbers
        self._questions[number] = Question(node, subject, self._loop.time())
        return number

    def _answers(self, number: int, node: int, subject: Any, asked: float) -> bool:
        question = self._questions[number]
        return question is not None and (question.node, question.subject) == (node, subject) and question.received_at >= asked


class SmsOracle(Oracle):
    """The number is in the last two bytes of a span, and the bytes before follow from it. The end of a span identifies the
    request: the driver may begin a byte earlier than its caller's span, so that the echo of the request cannot be the reply."""

    head = "    protocol: sms\n    baudrate: 1000000\n"
    servo = ", model: sts"
    ID_ADDRESS = 5
    SPANS = ("56:2", "58:2", "56:4", "56:6", "40:3", "56:15")

    def answer(self, frame: bytes) -> bytes | None:
        codec = SmsCodec()
        codec.receive_data(frame)
        packet = codec.next_reply()
        if packet is None or not 1 <= packet.id <= SERVOS:
            return None
        data = b""
        if packet.code == Instruction.READ:
            address, size = packet.params
            if address == self.ID_ADDRESS:
                data = bytes((packet.id, *bytes(size - 1)))
            elif size < 2:
                data = bytes(size)  # too short for a number: only discovery reads it
            else:
                data = self._data(self._number(packet.id, address + size), size)
        return sms_encode(packet.id, 0, data)

    def register(self, rng: random.Random) -> str:
        return rng.choice(self.SPANS)

    def right(self, value: Sequence[int], node: int, register: str, asked: float) -> bool:
        address, size = map(int, register.split(":"))
        number = int.from_bytes(bytes(value[-2:]), "little")
        expected = self._data(number, size + 1)[-size:], self._data(number, size)
        return self._answers(number, node, address + size, asked) and len(value) == size and bytes(value) in expected

    def rename(self, frame: bytes, rng: random.Random) -> bytes:
        return sms_encode(frame[2] % SERVOS + 1, frame[4], frame[5:-1])

    @staticmethod
    def _data(number: int, size: int) -> bytes:
        return bytes((number * at + at) & 0xFF for at in range(2, size)) + number.to_bytes(2, "little")


class KstOracle(Oracle):
    """Position, status and version are numbers. Only positions in the servo's range are believed, so there are fewer numbers."""

    head = "    protocol: kst\n    baudrate: 512000\n"
    servo = ""
    REGISTERS = ("position", "status", "firmware")
    POSITIONS = 1801
    CODES = dict(zip(REGISTERS, (Command.READ_POSITION, Command.READ_STATUS, Command.READ_VERSION), strict=True))

    def answer(self, frame: bytes) -> bytes | None:
        codec = KstCodec()
        codec.receive_data(frame)
        request = codec.next_reply()
        if request is None or not 1 <= request.node <= SERVOS:
            return None
        command = Command(frame[3])
        data = bytes((request.node,))
        if command != Command.READ_ID:
            number = self._number(request.node, command, self.POSITIONS)
            minimum = -900 if command == Command.READ_POSITION else 0
            data = (number + minimum).to_bytes(2, "little", signed=True)
        return kst_encode(request.node, command + 0x40, data)

    def register(self, rng: random.Random) -> str:
        return rng.choice(self.REGISTERS)

    def right(self, value: int, node: int, register: str, asked: float) -> bool:
        number = value + 900 if register == "position" else value
        return 0 <= number < self.POSITIONS and self._answers(number, node, self.CODES[register], asked)

    def rename(self, frame: bytes, rng: random.Random) -> bytes:
        return kst_encode(frame[2] % SERVOS + 1, frame[3], frame[4:12])


class RohOracle(Oracle):
    """The number is the last register that is read. The registers that tell the map of the hand are the real ones."""

    head = "    protocol: roh\n    baudrate: 115200\n"
    servo = ", channel: index"
    FIRST = (0x0200, 0x0301, 5, 0x2001, 1, 0, 2, 0, 1)
    SPANS = ("1145:1", "1155:1", "1145:2", "1185:6", "1105:6", "1145:12")

    def answer(self, frame: bytes) -> bytes | None:
        codec = ModbusCodec("device")
        codec.receive_data(frame)
        request = codec.next_reply()
        if request is None or not 1 <= request.unit <= SERVOS or request.function != Function.READ_HOLDING:
            return None
        address, count = unpack(request.data)
        if address == 1000:
            registers = list(self.FIRST[:count])
        else:
            registers = self._registers(self._number(request.unit, (address, count)), count)
        return modbus_encode(request.unit, request.function, bytes((2 * count,)) + pack(registers))

    def register(self, rng: random.Random) -> str:
        return rng.choice(self.SPANS)

    def right(self, value: Sequence[int], node: int, register: str, asked: float) -> bool:
        address, count = map(int, register.split(":"))
        return self._answers(value[-1], node, (address, count), asked) and list(value) == self._registers(value[-1], count)

    def rename(self, frame: bytes, rng: random.Random) -> bytes:
        return modbus_encode(frame[0] % SERVOS + 1, frame[1], frame[2:-2])

    @staticmethod
    def _registers(number: int, count: int) -> list[int]:
        return [(number * at) & 0xFFFF for at in range(2, count + 1)] + [number]


ORACLES: dict[str, type[Oracle]] = {"sms": SmsOracle, "kst": KstOracle, "roh": RohOracle}


def service(protocol: str, faults: FaultOptions) -> tuple[BusService, Link, Oracle]:
    """Return a bus on an oracle with the faults in between, its link (not connected yet), and the oracle."""
    loop = asyncio.get_running_loop()
    oracle = ORACLES[protocol](loop)
    servos = "".join(f"      s{number}: {{id: {number}{oracle.servo}}}\n" for number in range(1, SERVOS + 1))
    text = f"version: 1\nbuses:\n  line:\n{oracle.head}    port: 'sim:'\n    servos:\n{servos}"
    config = parse_config(text, "campaign", Path())
    options, models = config.buses["line"], config.models["line"]
    definition = PROTOCOLS[protocol]
    far = FaultyEnd(oracle, faults, loop, rename=oracle.rename, node_of=definition.node_of)
    link = MemoryLink(far, LineTraits())
    bus = BusService("line", options, definition.driver(options, models), definition.codec(options), link.traits, _event)
    return bus, link, oracle


def _event(name: str, **fields: object) -> None:
    """Do nothing: campaigns count, they do not log."""
