"""A ROH hand as its Modbus document describes it (map of protocol version 2); see `witness.py`.

A step is 1/65535 of a finger's way.
With `gateway` the silence of the hand is answered by exception 0x0B, as an arm or a Modbus gateway does.
"""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence

from tests.campaigns.witness import Joint, WitnessLine, WitnessServo

READ, WRITE_ONE, WRITE = 3, 6, 16
VERSION, FIRMWARE, REVISION, HARDWARE, NODE_ID, SUB_EXCEPTION = 1000, 1001, 1002, 1003, 1005, 1006
STATUS, CURRENT_LIMIT, SPEED, POS_TARGET, POS, END = 1085, 1095, 1125, 1135, 1145, 1300
CHANNELS = 6
FULL_SPEED = 65535.0
NO_ANSWER = 0x0B
BOOT = 0.2
"""Seconds that it needs to start, beside its self-test."""


class RohHand(WitnessServo):
    """One unit with six fingers, open at first."""

    def __init__(self, node: int, *, position: int = 20000) -> None:
        super().__init__(node)
        self.registers = dict.fromkeys(range(VERSION, END), 0)
        self.registers |= {VERSION: 0x0200, FIRMWARE: 0x0301, REVISION: 79, HARDWARE: 0x2001, NODE_ID: node}
        self.fingers = [Joint(position) for _ in range(CHANNELS)]
        self._start()
        for channel in range(CHANNELS):
            self.registers[POS_TARGET + channel] = position

    def _start(self) -> None:
        for channel in range(10):
            self.registers[CURRENT_LIMIT + channel] = 1299
            self.registers[SPEED + channel] = 65535
            self.registers[POS_TARGET + channel] = 0

    def advance(self, now: float) -> None:
        for channel, finger in enumerate(self.fingers):
            if now < self.off_until:
                finger.hang(now)
            else:
                finger.go(now, self.registers[POS_TARGET + channel], self.registers[SPEED + channel])

    def driven(self) -> float:
        return sum(finger.driven for finger in self.fingers)

    def moves(self) -> bool:
        return any(abs(self.registers[POS_TARGET + at] - finger.position) > 0.5 for at, finger in enumerate(self.fingers))

    def cut_power(self, now: float, seconds: float) -> None:
        """It opens its fingers as it starts: that is its own, and ends with the power."""
        self.advance(now)
        self.off_until = now + seconds + BOOT
        self._start()
        for finger in self.fingers:
            finger.position = 0.0

    def read(self, address: int) -> int:
        channel = address - POS
        if 0 <= channel < CHANNELS:
            return round(self.fingers[channel].position)
        if STATUS <= address < STATUS + CHANNELS:
            at = address - STATUS
            way = self.registers[POS_TARGET + at] - self.fingers[at].position
            return 2 if abs(way) <= 0.5 else int(way > 0)
        return self.registers[address]

    def write(self, address: int, value: int, now: float) -> None:
        if POS_TARGET <= address < POS_TARGET + CHANNELS and value != self.registers[address]:
            self.energised_at.append(now)
        self.registers[address] = value


class RohLine(WitnessLine):
    servos: dict[int, RohHand]  # type: ignore[assignment]

    def __init__(self, servos: Sequence[RohHand], *, baudrate: int = 115_200, rng: random.Random, gateway: bool = False) -> None:
        super().__init__(servos, baudrate=baudrate, rng=rng)
        self.gateway = gateway

    def size_of(self, data: bytes) -> int:
        if len(data) < 8:
            return 0
        size = 9 + data[6] if data[1] == WRITE else 8
        if len(data) < size:
            return 0
        return size if crc(data[: size - 2]) == data[size - 2 : size] else -1

    def answers(self, frame: bytes, now: float) -> Iterator[tuple[int, bytes]]:
        unit, function = frame[0], frame[1]
        hand = self.servos.get(unit)
        reply = b""
        if hand is not None and hand.receives(now, self.rng):
            hand.advance(now)
            reply = self._reply(hand, frame, now)
            if not hand.replies(now, self.rng):
                reply = b""
        if reply:
            yield unit, reply
        elif self.gateway and unit:
            yield unit, framed(bytes((unit, function | 0x80, NO_ANSWER)))

    @staticmethod
    def _reply(hand: RohHand, frame: bytes, now: float) -> bytes:
        unit, function = frame[0], frame[1]
        address, count = int.from_bytes(frame[2:4], "big"), int.from_bytes(frame[4:6], "big")
        last = address + (1 if function == WRITE_ONE else count)
        if not VERSION <= address < last <= END:
            return framed(bytes((unit, function | 0x80, 2)))
        if function == READ:
            data = b"".join(hand.read(each).to_bytes(2, "big") for each in range(address, last))
            return framed(bytes((unit, function, len(data))) + data)
        values = frame[4:6] if function == WRITE_ONE else frame[7:-2]
        for at in range(0, len(values), 2):
            hand.write(address + at // 2, int.from_bytes(values[at : at + 2], "big"), now)
        return framed(frame[:6])


def crc(data: bytes) -> bytes:
    """CRC-16 of Modbus, low byte first."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ 0xA001 if value & 1 else value >> 1
    return value.to_bytes(2, "little")


def framed(content: bytes) -> bytes:
    return content + crc(content)
