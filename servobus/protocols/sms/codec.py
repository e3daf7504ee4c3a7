"""SMS 1.0 packets (1.1 to 1.4): header FF FF, id, length, instruction or status, parameters, checksum.

Both directions have the same shape, so one codec serves the master and the simulated servo: `Packet.code` is the instruction of a
request and the health byte of a reply. Two tables say which instructions are answered: `WRITES` and `ANSWERED_BROADCASTS`.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from random import Random
from typing import NamedTuple

from servobus.protocols.stream import StreamCodec, decode_single

HEADER = b"\xff\xff"
BROADCAST_ID = 0xFE
MAX_ID = 0xFD
OVERHEAD = 6
"""Bytes of a packet without parameters: header, id, length, code, checksum."""
MAX_PARAMETERS = 253
"""The length byte counts the parameters and two more."""


class Instruction(IntEnum):
    """SMS 1.0, 1.3 and 1.4; SYNC_READ is from FEETECH's later manuals, for models that have it."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    RESET = 0x06
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83


WRITES = frozenset({Instruction.WRITE, Instruction.REG_WRITE, Instruction.ACTION, Instruction.RESET})
"""A servo answers these only at response level 1 (FEETECH memory table, address 8)."""
ANSWERED_BROADCASTS = frozenset({Instruction.PING, Instruction.SYNC_READ})
"""No servo answers a broadcast, except these (SMS 1.0, 1.1)."""


class Packet(NamedTuple):
    """One packet in either direction."""

    node: int
    status: int
    params: bytes
    frame: bytes

    @property
    def id(self) -> int:
        return self.node

    @property
    def code(self) -> int:
        """The instruction of a request, the health byte of a reply."""
        return self.status

    @property
    def key(self) -> int:
        """Replies of one servo differ only in their number of parameters."""
        return len(self.params)


def checksum(content: bytes) -> int:
    """Return the inverted low byte of the sum of all bytes between header and checksum."""
    return ~sum(content) & 0xFF


def encode(servo_id: int, code: int, params: bytes = b"") -> bytes:
    """Return the bytes of a packet. Raises ValueError for an id or a length that a packet cannot carry."""
    if not 0 <= servo_id <= BROADCAST_ID:
        raise ValueError(f"id {servo_id} is outside 0 to {MAX_ID} (or {BROADCAST_ID} for all)")
    if len(params) > MAX_PARAMETERS:
        raise ValueError(f"{len(params)} parameters do not fit in a packet of at most {MAX_PARAMETERS}")
    content = bytes((servo_id, len(params) + 2, code)) + params
    return HEADER + content + bytes((checksum(content),))


class SmsCodec(StreamCodec[Packet]):
    """Finds packets in a stream of bytes. It keeps at most one undecided packet (259 bytes) between two calls."""

    __slots__ = ()

    def next_reply(self) -> Packet | None:
        """Return the next packet with a right checksum; bytes that cannot begin one are skipped and counted."""
        data = self.buffer
        size = len(data)
        # Nearly always exactly one whole packet was received.
        if (
            size >= OVERHEAD
            and data[3] == size - 4
            and data[:2] == HEADER
            and data[2] <= BROADCAST_ID
            and ~sum(data[2:-1]) & 0xFF == data[-1]
        ):
            self.buffer = b""
            return Packet(data[2], data[4], data[5:-1], data)
        return self._search() if data else None

    def _search(self) -> Packet | None:
        data, at = self.buffer, 0
        while (start := data.find(HEADER, at)) >= 0:
            if len(data) < start + 4:
                self.skip(start)
                return None
            servo_id, length = data[start + 2], data[start + 3]
            end = start + 4 + length
            at = start + 1
            if servo_id > BROADCAST_ID or length < 2:
                continue
            if len(data) < end:
                self.skip(start)
                return None
            if checksum(data[start + 2 : end - 1]) == data[end - 1]:
                frame = self.cut(start, end)
                return Packet(servo_id, frame[4], frame[5:-1], frame)
        self.skip_to_header(HEADER, at)
        return None

    def describe(self, frame: bytes, *, sent: bool) -> str:
        """Return one line of text for a frame."""
        return describe(frame, sent=sent)


def rename(frame: bytes, rng: Random) -> bytes:
    """Return the same packet with the id of another servo."""
    return encode((frame[2] + rng.randint(1, MAX_ID)) % (MAX_ID + 1), frame[4], frame[5:-1])


def node_of(frame: bytes) -> int:
    """Return the id of a whole packet."""
    return frame[len(HEADER)]


def describe(frame: bytes, *, sent: bool) -> str:
    """Return the line that `decode` and `--trace` print for a packet."""
    packet = decode_single(SmsCodec(), frame)
    if packet is None:
        return f"no SMS packet: {frame.hex(' ')}"
    who = "all" if packet.id == BROADCAST_ID else f"id {packet.id}"
    if not sent:
        health = "ok" if packet.code == 0 else f"status 0x{packet.code:02X}"
        return f"{who} {health}" + (f" data {packet.params.hex(' ')}" if packet.params else "")
    try:
        name = Instruction(packet.code).name
    except ValueError:
        name = f"instruction 0x{packet.code:02X}"
    return f"{who} {name}{_describe_parameters(packet.code, packet.params)}"


def _describe_parameters(code: int, params: Sequence[int]) -> str:
    data = bytes(params)
    if code == Instruction.READ and len(data) == 2:
        return f" 0x{data[0]:02X} {data[1]} bytes"
    if code in (Instruction.WRITE, Instruction.REG_WRITE) and data:
        return f" 0x{data[0]:02X} = {data[1:].hex(' ')}"
    if code == Instruction.SYNC_READ and len(data) >= 2:
        return f" 0x{data[0]:02X} {data[1]} bytes of ids {', '.join(map(str, data[2:]))}"
    if code == Instruction.SYNC_WRITE and len(data) >= 2:
        step = data[1] + 1
        parts = [data[at : at + step] for at in range(2, len(data), step)]
        return f" 0x{data[0]:02X} " + ", ".join(f"id {part[0]} = {part[1:].hex(' ')}" for part in parts)
    return f" {data.hex(' ')}" if data else ""
