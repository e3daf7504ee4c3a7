"""What FEETECH servos are asked: single registers, the whole state, and the polls of a bus."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from typing import Any

from servobus.errors import ServobusError
from servobus.protocols.base import Plan, Poll, Request, ask
from servobus.protocols.sms.codec import OVERHEAD
from servobus.protocols.sms.goals import MAX_FRAME_SECONDS
from servobus.protocols.sms.options import SmsBus
from servobus.protocols.sms.requests import Read, SyncRead
from servobus.protocols.sms.servo import HostServo
from servobus.protocols.spans import parse_span
from servobus.values import Loss, Update

Decoder = Callable[[bytes], Update]
TABLE_SIZE = 256
MAX_MISSED = 5
"""SYNC READs in a row that the same servo may miss before its group is asked one by one. A dead servo is offline before."""
RETRY_AFTER = 100
"""Requests after which it is asked together once more."""
MAX_READ = 250
"""Bytes that one READ brings at most: its reply counts them and two more in one byte."""


class Reader:
    """The reads of one bus. A request is immutable, so each is made once."""

    def __init__(self, options: SmsBus, servos: Mapping[str, HostServo]) -> None:
        self.options = options
        self.servos = servos
        self._states = {name: _state_read(servo) for name, servo in servos.items()}
        self._guards = self._blocks({servo.name: (servo.guard_span, servo.decode_guards) for servo in servos.values()})

    def state(self, name: str) -> Request[dict[str, Update]]:
        """Return the read of the whole state."""
        return self._states[name]

    def register(self, name: str, register: str, *, raw: bool) -> Request[Any]:
        """Return the read of a register, or of an ADDR:LEN. Raises UnknownName, NotSupported, LimitError."""
        servo = self.servos[name]
        request = servo.reads.get((register, raw))
        if request is None:
            span = parse_span(register, table_size=TABLE_SIZE, max_count=MAX_READ, servo=name)
            if span is not None:
                return Read(servo.node, *span, list)
            request = servo.reads[register, raw] = self._register_read(servo, register, raw=raw)
        return request

    @staticmethod
    def _register_read(servo: HostServo, name: str, *, raw: bool) -> Read[Any]:
        register = servo.model.readable(name)
        return servo.read_raw(register) if raw else servo.read_physical(servo.in_unit(register))

    def polls(self, rates: Mapping[str, float]) -> list[Poll]:
        """Return the polls: SYNC READ for the servos that know it and share a block, one READ for each of the others."""
        return [Poll(name, hz, block.nodes, block.request) for name, hz in rates.items() for block in self._polled(name)]

    def _polled(self, name: str) -> list[BlockRead]:
        feedback = name == "feedback"
        return self._blocks(
            {
                servo.name: (servo.model.feedback, servo.decode_feedback)
                if feedback
                else (servo.model.health, servo.decode_state)
                for servo in self.servos.values()
            }
        )

    def verify(self, servos: Collection[str]) -> Plan[Mapping[str, Loss]]:
        """Return the plan that reads torque and sentinel of these servos, and names those that are not as they were left."""
        nodes = [self.servos[name].node for name in servos]
        losses: dict[str, Loss] = {}
        for block in self._guards:
            updates = yield from _ask_all(block, [node for node in block.nodes if node in nodes])
            losses |= {name: update["loss"] for name, update in updates.items() if update["loss"] is not None}
        return losses

    def _blocks(self, wanted: Mapping[str, tuple[tuple[str, str], Decoder]]) -> list[BlockRead]:
        """Return the fewest reads of these blocks, which are given by their first and last register."""
        groups: dict[tuple[int, int, int], list[HostServo]] = {}
        for name, (ends, _) in wanted.items():
            servo = self.servos[name]
            alone = 0 if servo.model.sync_read else servo.node + 1
            groups.setdefault((*servo.model.block(*ends), alone), []).append(servo)
        blocks = []
        for (address, size, _), servos in groups.items():
            count = max_replies(self.options, size)
            for start in range(0, len(servos), count):
                decoders = {servo.node: (servo.name, wanted[servo.name][1]) for servo in servos[start : start + count]}
                blocks.append(BlockRead(address, size, decoders))
        return blocks


def max_replies(options: SmsBus, size: int) -> int:
    """Return how many servos one SYNC READ asks for `size` bytes each: at least 1."""
    return max(1, int(MAX_FRAME_SECONDS * options.baudrate / 10) // (size + OVERHEAD))


class BlockRead:
    """The same block of several servos. It keeps its last request, because the same servos are asked nearly always.

    Where the same servo is always missing from a SYNC READ though it answers when it is asked alone (noise between two replies),
    one servo after another is asked instead, for a while.
    """

    def __init__(self, address: int, size: int, decoders: Mapping[int, tuple[str, Decoder]]) -> None:
        self.address, self.size = address, size
        self.nodes = tuple(decoders)
        self._decoders = decoders
        self._last: tuple[list[int], Request[dict[str, Update]] | None] = ([], None)
        self._missed: dict[int, int] = {}
        """Node -> SYNC READs in a row that it did not answer."""
        self._alone = 0
        """Requests for which servos are asked alone."""

    def request(self, reachable: Collection[int]) -> Request[dict[str, Update]] | None:
        """Return the read of the reachable servos; None: none is reachable."""
        nodes = [node for node in self.nodes if node in reachable]
        if len(nodes) > 1:
            nodes = self._together_or_one(nodes)
        if nodes != self._last[0]:
            self._last = (nodes, self._make(nodes))
        return self._last[1]

    def _together_or_one(self, nodes: list[int]) -> list[int]:
        missed = self._missed
        for node in nodes:
            missed[node] = missed.get(node, 0) + 1
        if not self._alone and max(missed[node] for node in nodes) > MAX_MISSED:
            self._alone = RETRY_AFTER
            missed.clear()
        if self._alone:
            self._alone -= 1
            return [nodes[self._alone % len(nodes)]]
        return nodes

    def _make(self, nodes: Sequence[int]) -> Request[dict[str, Update]] | None:
        if not nodes:
            return None
        if len(nodes) > 1:
            return SyncRead(self.address, self.size, nodes, self._decode)
        name, decode = self._decoders[nodes[0]]
        return Read(nodes[0], self.address, self.size, lambda data: {name: decode(data)})

    def _decode(self, data: Mapping[int, bytes]) -> dict[str, Update]:
        self._missed.update(dict.fromkeys(data, 0))
        updates = {}
        for node, block in data.items():
            name, decode = self._decoders[node]
            updates[name] = decode(block)
        return updates


def _ask_all(block: BlockRead, nodes: Sequence[int]) -> Plan[dict[str, Update]]:
    """Read a block of these nodes: together, and alone where that failed. Who does not answer is left out: it is doubtful now."""
    together = block.request(nodes)
    if together is None:
        return {}
    if together.nodes == tuple(nodes):
        with suppress(ServobusError):
            return (yield from ask(together))
    updates: dict[str, Update] = {}
    for node in nodes if len(nodes) > 1 else ():
        updates |= yield from _ask_all(block, (node,))
    return updates


def _state_read(servo: HostServo) -> Read[dict[str, Update]]:
    address, size = servo.model.block(*servo.model.health)
    return Read(servo.node, address, size, lambda data: {servo.name: servo.decode_state(data)})
