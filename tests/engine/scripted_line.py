"""A bus whose far end does what the test says, in virtual time."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager

from servobus.bus.service import BusService
from servobus.links.memory import MemoryLink
from servobus.protocols.base import LineTraits
from servobus.protocols.registry import PROTOCOLS
from servobus.protocols.sms.codec import Instruction, SmsCodec, encode
from servobus.protocols.sms.model import packaged_models
from servobus.protocols.sms.simulated.registers import RegisterTable
from tests.simulated_rigs import config

Answers = Sequence[tuple[float, bytes]]
"""Seconds from the question, bytes."""


def table_of(node: int, **registers: int) -> RegisterTable:
    """The memory of an STS as `enable` leaves it, and what else these registers hold."""
    table = RegisterTable(packaged_models()["sts"])
    for name, raw in {"id": node, "torque_enable": 1, "acceleration": 254, **registers}.items():
        table.put(table.registers[name], raw)
    return table


class Puppet:
    """Answers READ from a memory that no write changes, and all else with health 0, until `script` is set."""

    def __init__(self) -> None:
        self.tables: dict[int, RegisterTable] = {}
        """Node -> its memory; an enabled STS that stands at step 0 unless a test puts another one there."""
        self.script: Callable[[bytes], Answers | None] = lambda frame: None
        """None: as usual."""
        self.frames: list[bytes] = []
        self.baudrates: list[int] = []
        self._loop = asyncio.get_running_loop()
        self._deliver: Callable[[bytes], object] = bytes
        self._until: dict[int, float] = {}
        """A servo and its UART are a queue: no answer of one overtakes another."""

    def attach(self, deliver: Callable[[bytes], None]) -> None:
        self._deliver = deliver

    def receive(self, data: bytes) -> None:
        self.frames.append(data)
        script = self.script(data)
        for delay, answer in self.usual(data) if script is None else script:
            due = max(self._loop.time() + delay, self._until.get(data[2], 0.0))
            self._until[data[2]] = due
            self._loop.call_at(due, self._deliver, answer)

    def set_baudrate(self, baudrate: int) -> None:
        self.baudrates.append(baudrate)

    def say(self, data: bytes) -> None:
        """Now, unasked."""
        self._deliver(data)

    def usual(self, data: bytes) -> Answers:
        codec = SmsCodec()
        codec.receive_data(data)
        packet = codec.next_reply()
        assert packet is not None
        if packet.code == Instruction.SYNC_READ:
            return [(0.001, self._reply(node, *packet.params[:2])) for node in packet.params[2:]]
        if packet.id == 0xFE:
            return []
        if packet.code != Instruction.READ:
            return [(0.001, encode(packet.id, 0))]
        return [(0.001, self._reply(packet.id, *packet.params))]

    def _reply(self, node: int, address: int, size: int) -> bytes:
        table = self.tables.get(node) or self.tables.setdefault(node, table_of(node))
        return encode(node, 0, table.read(address, size))


class Events(list[str]):
    """Names of what the bus reported."""

    def __call__(self, name: str, **fields: object) -> None:
        self.append(name)


@asynccontextmanager
async def puppet_bus(
    *servos: str, traits: LineTraits | None = None, started: bool = True, **keys: str
) -> AsyncIterator[tuple[BusService, Puppet, MemoryLink, Events]]:
    """A bus of two STS, identified unless `started` is False."""
    setup = config(*(servos or ("s1: {id: 1, model: sts}", "s2: {id: 2, model: sts}")), **keys)
    options, models = setup.buses["arm"], setup.models["arm"]
    puppet, events, protocol = Puppet(), Events(), PROTOCOLS["sms"]
    link = MemoryLink(puppet, traits or LineTraits(can_change_baud=True))
    bus = BusService("arm", options, protocol.driver(options, models), protocol.codec(options), link.traits, events)
    await link.connect(bus.master)
    if started:
        await bus.start()
        puppet.frames.clear()
    try:
        yield bus, puppet, link, events
    finally:
        await bus.master.close()
