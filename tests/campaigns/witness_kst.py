"""KST servos as KST RS422 describes them: FE CA id command 8 bytes sum 0A; see `witness.py`. A step is 0.1 degrees.

The document says nothing about speed: the witness goes to each position as fast as it can, and to its default after a restart.
"""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence

from tests.campaigns.witness import Joint, WitnessLine, WitnessServo

STATUS, SET_POSITION, READ_ID, READ_POSITION, READ_VERSION = 0x10, 0x09, 0x18, 0x19, 0x1A
SIZE = 14
FULL_SPEED = 4000.0
DEFAULT = 0.0
BOOT = 0.2
"""Seconds that it needs to start. A restart that takes no time, between two setpoints, shows on no wire."""


class KstServo(WitnessServo):
    def __init__(self, node: int, *, position: float = 0.0) -> None:
        super().__init__(node)
        self.joint = Joint(position)
        self.goal = position
        self.blocked = False
        self.max_gap = 0.0
        """The farthest that a position sent to it was from where it was, in steps."""

    def advance(self, now: float) -> None:
        if now < self.off_until or self.blocked:
            self.joint.hang(now)
        else:
            self.joint.go(now, self.goal, FULL_SPEED)

    def driven(self) -> float:
        return self.joint.driven

    def moves(self) -> bool:
        return not self.blocked and abs(self.goal - self.joint.position) > 0.5

    def cut_power(self, now: float, seconds: float) -> None:
        self.advance(now)
        self.off_until = now + seconds + BOOT
        self.goal = DEFAULT

    def set_position(self, goal: float, now: float) -> None:
        self.max_gap = max(self.max_gap, abs(goal - self.joint.position))
        if abs(goal - self.goal) > 0.5:
            self.energised_at.append(now)
        self.goal = goal


class KstLine(WitnessLine):
    servos: dict[int, KstServo]  # type: ignore[assignment]

    def __init__(self, servos: Sequence[KstServo], *, baudrate: int = 512_000, rng: random.Random) -> None:
        super().__init__(servos, baudrate=baudrate, rng=rng)

    def size_of(self, data: bytes) -> int:
        if data[:2] != b"\xfe\xca"[: len(data)]:
            return -1
        if len(data) < SIZE:
            return 0
        return SIZE if data[13] == 0x0A and sum(data[1:12]) & 0xFF == data[12] else -1

    def answers(self, frame: bytes, now: float) -> Iterator[tuple[int, bytes]]:
        node, command, data = frame[2], frame[3], frame[4:12]
        servo = self.servos.get(node)
        if servo is None or not servo.receives(now, self.rng):
            return
        servo.advance(now)
        reply = bytes(8)
        if command == SET_POSITION:
            servo.set_position(int.from_bytes(data[:2], "little", signed=True), now)
            reply = data
        elif command == READ_POSITION:
            reply = round(servo.joint.position).to_bytes(2, "little", signed=True) + bytes(6)
        elif command == READ_ID:
            reply = bytes((node, *bytes(7)))
        elif command == READ_VERSION:
            reply = b"V1.0" + bytes(4)
        if servo.replies(now, self.rng):
            yield node, encode(node, command + 0x40, reply)


def encode(node: int, command: int, data: bytes) -> bytes:
    content = bytes((0xCA, node, command)) + data
    return b"\xfe" + content + bytes((sum(content) & 0xFF, 0x0A))
