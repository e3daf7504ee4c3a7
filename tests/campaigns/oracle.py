"""A line whose every answer is different and says which question it answers, so that a wrong one cannot pass for right.

The last two bytes of an answer are a number that counts up; what was asked, of whom and when, is remembered under it. The bytes
before follow from the number. A value is right when it answers the question that its caller asked, and no earlier one.
"""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from servobus.bus.service import BusService
from servobus.config import parse_config
from servobus.links.base import Link
from servobus.links.faulty import FaultyEnd
from servobus.links.memory import MemoryLink
from servobus.protocols.base import LineTraits
from servobus.protocols.options import FaultOptions
from servobus.protocols.sms.codec import Instruction, Packet, SmsCodec, encode, node_of
from servobus.protocols.table import PROTOCOLS

SERVOS = 10
NUMBERS = 1 << 16
ID_ADDRESS = 5


@dataclass(frozen=True, slots=True)
class Question:
    node: int
    address: int
    size: int
    heard: float


class Oracle:
    """A FarEnd of servos that answer READ from a counter, and acknowledge whatever else is addressed to them."""

    def __init__(self, nodes: Sequence[int], loop: asyncio.AbstractEventLoop) -> None:
        self.nodes = frozenset(nodes)
        self._loop = loop
        self._codec = SmsCodec()
        self._deliver: Callable[[bytes], object] = bytes
        self._questions: list[Question | None] = [None] * NUMBERS
        self._count = 0

    def attach(self, deliver: Callable[[bytes], None]) -> None:
        self._deliver = deliver

    def set_baudrate(self, baudrate: int) -> None:
        """It has none."""

    def receive(self, data: bytes) -> None:
        self._codec.receive_data(data)
        while (packet := self._codec.next_reply()) is not None:
            if packet.id in self.nodes:
                self._loop.call_soon(self._deliver, encode(packet.id, 0, self._answer(packet)))

    def _answer(self, packet: Packet) -> bytes:
        if packet.code != Instruction.READ:
            return b""
        address, size = packet.params
        if address == ID_ADDRESS:
            return bytes((packet.id, *bytes(size - 1)))
        if size < 2:
            return bytes(size)  # too short for a number: asked only at the introduction
        self._count = number = (self._count + 1) % NUMBERS
        self._questions[number] = Question(packet.id, address, size, self._loop.time())
        return answer(number, size)

    def right(self, value: Sequence[int], node: int, address: int, asked: float) -> bool:
        """Whether this is the answer to a question asked of that node, up to the end of that span, not before `asked`. (A
        question may begin a byte earlier than its caller's span: so it is put where its echo could be the answer.)"""
        size = len(value)
        number = int.from_bytes(bytes(value[-2:]), "little")
        question = self._questions[number]
        return (
            question is not None
            and (question.node, question.address + question.size) == (node, address + size)
            and question.heard >= asked
            and bytes(value) == answer(number, question.size)[-size:]
        )


def answer(number: int, size: int) -> bytes:
    return bytes((number * at + at) & 0xFF for at in range(2, size)) + number.to_bytes(2, "little")


def _neighbour(frame: bytes, rng: random.Random) -> bytes:
    """The same packet in the name of the next servo, which exists."""
    return encode(frame[2] % SERVOS + 1, frame[4], frame[5:-1])


def service(nodes: int, faults: FaultOptions | None = None, *, echo: str = "off") -> tuple[BusService, Link, Oracle]:
    """A bus of so many servos on an oracle, with the faults in between; the link is to be connected."""
    loop = asyncio.get_running_loop()
    servos = "".join(f"      s{number}: {{id: {number}, model: sts}}\n" for number in range(1, nodes + 1))
    head = "version: 1\nbuses:\n  arm:\n    protocol: sms\n    port: 'sim:'\n    baudrate: 1000000\n"
    config = parse_config(f"{head}    echo: {echo}\n    servos:\n{servos}", "campaign", Path())
    options, models = config.buses["arm"], config.models["arm"]
    oracle = Oracle(range(1, nodes + 1), loop)
    far = oracle if faults is None else FaultyEnd(oracle, faults, loop, rename=_neighbour, node_of=node_of)
    link = MemoryLink(far, LineTraits())
    entry = PROTOCOLS[options.protocol]
    bus = BusService("arm", options, entry.driver(options, models), entry.codec(options), link.traits, _event)
    return bus, link, oracle


def _event(name: str, **fields: object) -> None:
    """Campaigns count; they do not log."""
