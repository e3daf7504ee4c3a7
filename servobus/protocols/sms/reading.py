"""What FEETECH servos are asked: single registers, the whole state, and the polls of a bus."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

from servobus.protocols.base import Poll, Request
from servobus.protocols.sms.codec import OVERHEAD
from servobus.protocols.sms.goals import MAX_FRAME_SECONDS
from servobus.protocols.sms.options import SmsBus
from servobus.protocols.sms.requests import Read, SyncRead
from servobus.protocols.sms.servo import HostServo
from servobus.protocols.spans import parse_span
from servobus.values import Update

TABLE_SIZE = 256
MAX_READ = 250
"""Bytes that one READ brings at most: its reply counts them and two more in one byte."""


class Reader:
    """The reads of one bus. A request is immutable, so each is made once."""

    def __init__(self, options: SmsBus, servos: Mapping[str, HostServo]) -> None:
        self.options = options
        self.servos = servos
        self.registers: dict[tuple[str, str, bool], Request[Any]] = {}
        """The reads that were made already, by servo, register and `raw`."""
        self._states = {name: _state_read(servo) for name, servo in servos.items()}

    def state(self, name: str) -> Request[dict[str, Update]]:
        """Return the read of the whole state."""
        return self._states[name]

    def register(self, name: str, register: str, *, raw: bool) -> Request[Any]:
        """Return the read of a register, or of an ADDR:LEN. Raises UnknownName, NotSupported, LimitError."""
        request = self.registers.get((name, register, raw))
        if request is None:
            servo = self.servos[name]
            span = parse_span(register, table_size=TABLE_SIZE, max_count=MAX_READ, servo=name)
            if span is not None:
                return Read(servo.node, *span, list)
            request = self.registers[name, register, raw] = self._register_read(servo, register, raw=raw)
        return request

    @staticmethod
    def _register_read(servo: HostServo, name: str, *, raw: bool) -> Read[Any]:
        register = servo.model.readable(name)
        return servo.read_raw(register) if raw else servo.read_physical(register)

    def polls(self, rates: Mapping[str, float]) -> list[Poll]:
        """Return the polls: SYNC READ for the servos that know it and share a block, one READ for each of the others."""
        return [poll for name, hz in rates.items() for poll in self._polls(name, hz)]

    def _polls(self, name: str, hz: float) -> list[Poll]:
        groups: dict[tuple[int, int, int], list[HostServo]] = {}
        for servo in self.servos.values():
            block = servo.model.block(*(servo.model.feedback if name == "feedback" else servo.model.health))
            alone = 0 if servo.model.sync_read else servo.node + 1
            groups.setdefault((*block, alone), []).append(servo)
        polls = []
        for (address, size, _), servos in groups.items():
            count = max(1, int(MAX_FRAME_SECONDS * self.options.baudrate / 10) // (size + OVERHEAD))
            for start in range(0, len(servos), count):
                block_read = BlockRead(name, address, size, servos[start : start + count])
                polls.append(Poll(name, hz, block_read.nodes, block_read.request))
        return polls


class BlockRead:
    """One poll: the same block of several servos. It keeps its last request, because the same servos answer nearly always."""

    def __init__(self, name: str, address: int, size: int, servos: Sequence[HostServo]) -> None:
        self.address, self.size = address, size
        self.nodes = tuple(servo.node for servo in servos)
        self._decoders: dict[int, tuple[str, Callable[[bytes], Update]]] = {
            servo.node: (servo.name, servo.decode_feedback if name == "feedback" else servo.decode_state) for servo in servos
        }
        self._last: tuple[list[int], Request[dict[str, Update]] | None] = ([], None)

    def request(self, reachable: Collection[int]) -> Request[dict[str, Update]] | None:
        """Return the read of the reachable servos; None: none is reachable."""
        nodes = [node for node in self.nodes if node in reachable]
        if nodes != self._last[0]:
            self._last = (nodes, self._make(nodes))
        return self._last[1]

    def _make(self, nodes: Sequence[int]) -> Request[dict[str, Update]] | None:
        if not nodes:
            return None
        if len(nodes) > 1:
            return SyncRead(self.address, self.size, nodes, self._decode)
        name, decode = self._decoders[nodes[0]]
        return Read(nodes[0], self.address, self.size, lambda data: {name: decode(data)})

    def _decode(self, data: Mapping[int, bytes]) -> dict[str, Update]:
        updates = {}
        for node, block in data.items():
            name, decode = self._decoders[node]
            updates[name] = decode(block)
        return updates


def _state_read(servo: HostServo) -> Read[dict[str, Update]]:
    address, size = servo.model.block(*servo.model.health)
    return Read(servo.node, address, size, lambda data: {servo.name: servo.decode_state(data)})
