"""SMS 1.0 packets (seed 1.1 to 1.4): header FF FF, id, length, instruction or status, parameters, checksum.

Both directions have the same shape, so one codec serves master and simulated servo: `Packet.code` is the instruction of a request
and the health byte of a reply. Which instructions are answered is a table (`ANSWERED`), not a habit of the code.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from random import Random
from typing import NamedTuple

HEADER = b"\xff\xff"
BROADCAST_ID = 0xFE
MAX_ID = 0xFD
OVERHEAD = 6
"""Bytes of a packet without parameters: header, id, length, code, checksum."""
MAX_PARAMETERS = 253
"""The length byte counts the parameters and two more."""


class Instruction(IntEnum):
    """Seed 1.3; SYNC_READ from the vendor's later manuals, for models that have it."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    RESET = 0x06
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83


WRITES = frozenset({Instruction.WRITE, Instruction.REG_WRITE, Instruction.ACTION, Instruction.RESET})
"""Answered only at response level 1 (feetech.md, section 4)."""
ANSWERED_BROADCASTS = frozenset({Instruction.PING, Instruction.SYNC_READ})
"""A broadcast answers nothing, except these (seed 1.1)."""


class Packet(NamedTuple):
    """One packet, either way."""

    id: int
    code: int
    params: bytes
    frame: bytes

    @property
    def node(self) -> int:
        return self.id

    @property
    def status(self) -> int:
        return self.code

    @property
    def key(self) -> int:
        """Replies of one servo differ in nothing but their number of parameters."""
        return len(self.params)


def checksum(body: bytes) -> int:
    """Of everything between header and checksum: the inverted low byte of the sum."""
    return ~sum(body) & 0xFF


def encode(servo_id: int, code: int, params: bytes = b"") -> bytes:
    """The packet's bytes. Raises ValueError for an id or a length the frame cannot carry."""
    if not 0 <= servo_id <= BROADCAST_ID:
        raise ValueError(f"id {servo_id} is outside 0 to {MAX_ID} (or {BROADCAST_ID} for all)")
    if len(params) > MAX_PARAMETERS:
        raise ValueError(f"{len(params)} parameters do not fit in a packet of at most {MAX_PARAMETERS}")
    body = bytes((servo_id, len(params) + 2, code)) + params
    return HEADER + body + bytes((checksum(body),))


class SmsCodec:
    """Finds packets in a stream. Memory is bounded: no more than one undecided packet (259 bytes) is kept between two calls."""

    __slots__ = ("_buffer", "skipped")

    def __init__(self) -> None:
        self._buffer = b""
        self.skipped = 0

    @property
    def pending(self) -> int:
        return len(self._buffer)

    def receive_data(self, data: bytes) -> None:
        self._buffer = self._buffer + data if self._buffer else bytes(data)

    def reset(self) -> None:
        self._buffer = b""

    def next_reply(self) -> Packet | None:
        """The next packet with a right checksum; what cannot begin one is skipped and counted."""
        buffer = self._buffer
        if not buffer:
            return None
        if self._is_one_packet(buffer):
            self._buffer = b""
            return Packet(buffer[2], buffer[4], buffer[5:-1], buffer)
        start = 0
        while True:
            found = buffer.find(HEADER, start)
            if found < 0:
                # A last FF may be half a header.
                keep = 1 if buffer.endswith(b"\xff") and len(buffer) > start else 0
                self._drop(len(buffer) - keep)
                return None
            if len(buffer) < found + 4:
                self._drop(found)
                return None
            servo_id, length = buffer[found + 2], buffer[found + 3]
            if servo_id > BROADCAST_ID or length < 2:
                start = found + 1
                continue
            end = found + 4 + length
            if len(buffer) < end:
                self._drop(found)
                return None
            if ~sum(buffer[found + 2 : end - 1]) & 0xFF != buffer[end - 1]:
                start = found + 1
                continue
            self.skipped += found
            self._buffer = buffer[end:]
            return Packet(servo_id, buffer[found + 4], buffer[found + 5 : end - 1], buffer[found:end])

    @staticmethod
    def _is_one_packet(data: bytes) -> bool:
        """What is heard nearly always: one whole packet, and nothing else."""
        size = len(data)
        return (
            size >= OVERHEAD
            and data[3] == size - 4
            and data[:2] == HEADER
            and data[2] <= BROADCAST_ID
            and ~sum(data[2:-1]) & 0xFF == data[-1]
        )

    def describe(self, frame: bytes, *, sent: bool) -> str:
        return describe(frame, sent=sent)

    def _drop(self, count: int) -> None:
        self.skipped += count
        self._buffer = self._buffer[count:]


def rename(frame: bytes, rng: Random) -> bytes:
    """The same packet in the name of another servo."""
    return encode((frame[2] + rng.randint(1, MAX_ID)) % (MAX_ID + 1), frame[4], frame[5:-1])


def node_of(frame: bytes) -> int:
    """The id of a whole packet."""
    return frame[len(HEADER)]


def describe(frame: bytes, *, sent: bool) -> str:
    """A packet in words: what `decode` and `--trace` print."""
    codec = SmsCodec()
    codec.receive_data(frame)
    packet = codec.next_reply()
    if packet is None or packet.frame != frame:
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
