"""The simulated end of a benchmark: answers SMS frames at once from a table of bytes, so that the client is what is measured.

The C program of `native.py` is used where a compiler is found. This file has the table for both and the same responder in
Python: `python -m tests.benchmarks.responder FD COUNTERS`.
"""

from __future__ import annotations

import mmap
import os
import struct
import sys
from collections.abc import Iterator

IMAGE = {
    0: 3,
    1: 10,
    3: 9,
    4: 3,
    7: 250,
    8: 1,
    11: 255,
    12: 15,
    13: 70,
    15: 40,
    16: 232,
    17: 3,
    18: 12,
    19: 44,
    20: 47,
    26: 1,
    27: 1,
}
IMAGE |= {28: 255, 29: 1, 30: 1, 34: 20, 35: 200, 36: 80, 38: 200, 48: 232, 49: 3, 55: 1, 57: 8, 62: 120, 63: 25}
"""The bytes that are not 0 in the memory of an STS3215 at rest in the middle of its range; address 5 holds the id."""

COUNTERS = struct.Struct("=QQ")
"""SYNC WRITE frames that arrived, and the servos in them."""

PING, READ, WRITE, REG_WRITE, ACTION, SYNC_READ, SYNC_WRITE, EVERYBODY = 1, 2, 3, 4, 5, 0x82, 0x83, 0xFE


def image_in_c() -> str:
    return ",".join(str(IMAGE.get(address, 0)) for address in range(256))


def reply(servo_id: int, data: bytes = b"") -> bytes:
    fields = bytes((servo_id, len(data) + 2, 0)) + data
    return b"\xff\xff" + fields + bytes((~sum(fields) & 0xFF,))


class Responder:
    """All ids at once, each with its own memory."""

    def __init__(self) -> None:
        self.memory = [bytearray(IMAGE.get(address, 0) for address in range(256)) for _ in range(256)]
        for servo_id, memory in enumerate(self.memory):
            memory[5] = servo_id
        self.pending: dict[int, bytes] = {}
        self.frames = self.servos = 0
        self._buffer = b""

    def receive(self, data: bytes) -> bytes:
        self._buffer += data
        return b"".join(self._answer(*packet) for packet in self._packets())

    def _packets(self) -> Iterator[tuple[int, int, bytes]]:
        while len(self._buffer) >= 6 and len(self._buffer) >= (size := self._buffer[3] + 4):
            packet, self._buffer = self._buffer[:size], self._buffer[size:]
            yield packet[2], packet[4], packet[5:-1]

    def _answer(self, servo_id: int, instruction: int, params: bytes) -> bytes:
        if instruction == READ:
            return self._read(servo_id, *params)
        if instruction == SYNC_READ:
            return b"".join(self._read(each, *params[:2]) for each in params[2:])
        if instruction == WRITE:
            self._store(servo_id, params)
        elif instruction == REG_WRITE:
            self.pending[servo_id] = params
        elif instruction == ACTION:
            for node, stored in self.pending.items():
                self._store(node, stored)
            self.pending.clear()
        elif instruction == SYNC_WRITE:
            self._sync_write(params)
        answered = instruction in (PING, WRITE, REG_WRITE) and servo_id != EVERYBODY
        return reply(servo_id) if answered else b""

    def _read(self, servo_id: int, address: int, size: int) -> bytes:
        return reply(servo_id, bytes(self.memory[servo_id][address : address + size]))

    def _store(self, servo_id: int, params: bytes) -> None:
        self.memory[servo_id][params[0] : params[0] + len(params) - 1] = params[1:]

    def _sync_write(self, params: bytes) -> None:
        self.frames += 1
        step = params[1] + 1
        for at in range(2, len(params) - step + 1, step):
            self.servos += 1
            self._store(params[at], params[:1] + params[at + 1 : at + step])


def main(descriptor: int, counters: str) -> None:
    responder = Responder()
    with open(counters, "r+b") as file, mmap.mmap(file.fileno(), COUNTERS.size) as shared:
        while request := os.read(descriptor, 4096):
            answer = responder.receive(request)
            COUNTERS.pack_into(shared, 0, responder.frames, responder.servos)
            os.write(descriptor, answer)


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2])
