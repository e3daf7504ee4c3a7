"""FEETECH servos as their memory tables and SMS 1.0 describe them, byte by byte; see `witness.py`.

Where a document leaves two ways open, the witness takes the one that is worse for the master: a goal switches torque on in every
mode, speed 0 is full speed, and a step goal is added to where the joint is.
"""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from tests.campaigns.witness import Joint, WitnessLine, WitnessServo

PING, READ, WRITE, REG_WRITE, ACTION, SYNC_READ, SYNC_WRITE = 1, 2, 3, 4, 5, 0x82, 0x83
ALL = 0xFE
END, MAJOR, MINOR, RESPONSE_LEVEL, MIN_LIMIT, MAX_LIMIT, MAX_TORQUE, PHASE = 2, 3, 4, 8, 9, 11, 16, 18
TORQUE, GOAL, PWM, SPEED, TORQUE_LIMIT = 40, 42, 44, 46, 48
POSITION, FLAG, STATUS, MOVING, GOAL_NOW = 56, 64, 65, 66, 67
FULL_SPEED = 3000.0
OVERLOAD = 0x20
BOOT = 0.2
"""Seconds that it needs to start; the vendor's protocol page says 1.8 s of a reboot."""


@dataclass(frozen=True, slots=True)
class Family:
    """What the vendor's tables say of one family."""

    major: int
    minor: int
    steps: int
    mode: int
    """Address of the mode; 0: none, it is a motor where both limits are 0."""
    modes: tuple[str, ...]
    big: bool = False
    torque_limit: bool = True
    sync_read: bool = False
    unit: int = 1
    """Steps/s of a count of speed where phase bit 2 is set."""


FAMILIES = {
    "sts": Family(9, 3, 4096, 33, ("position", "velocity", "pwm", "step"), sync_read=True),
    "sms": Family(8, 44, 4096, 33, ("position", "velocity", "pwm")),
    "sms_cl": Family(6, 3, 4096, 35, ("position", "velocity", "pwm"), torque_limit=False),
    "scs": Family(5, 15, 1024, 0, ("position", "motor"), big=True, torque_limit=False),
}


class SmsServo(WitnessServo):
    """One servo: its memory and its joint."""

    def __init__(self, node: int, family: str, *, mode: str = "position", position: int | None = None) -> None:
        super().__init__(node)
        self.family = FAMILIES[family]
        self.mode = mode
        self.joint = Joint(self.family.steps / 2 if position is None else position)
        self.memory = bytearray(128)
        self.armed: tuple[int, bytes] | None = None
        self.fired = 0
        """REG WRITEs that an ACTION has carried out."""
        self.lies: dict[int, int] = {}
        """Number of a read of its position, from 0 -> steps by which that reply is wrong, with the right sum."""
        self.position_reads = 0
        self._target = 0.0
        self._eeprom()
        self._start()

    def _eeprom(self) -> None:
        family, memory = self.family, self.memory
        memory[0:9] = bytes((3, 10, family.big, family.major, family.minor, self.node, 0, 0, 1))
        motor = self.mode == "motor"
        self.put(MIN_LIMIT, 0)
        self.put(MAX_LIMIT, 0 if motor else family.steps - 1)
        self.put(MAX_TORQUE, 1000)
        memory[PHASE] = 4
        if family.mode:
            memory[family.mode] = family.modes.index(self.mode)

    def _start(self) -> None:
        """RAM as after power-on."""
        self.memory[TORQUE:] = bytes(len(self.memory) - TORQUE)
        if self.family.torque_limit:
            self.put(TORQUE_LIMIT, self.word(MAX_TORQUE))
        self.armed = None
        self._target = self.joint.position

    # Words

    def word(self, address: int, sign: int = 0) -> int:
        value = int.from_bytes(self.memory[address : address + 2], "big" if self.family.big else "little")
        return -(value & ~(1 << sign)) if sign and value >> sign & 1 else value

    def put(self, address: int, value: int, sign: int = 0) -> None:
        if value < 0:
            value = -value | 1 << sign
        self.memory[address : address + 2] = (value & 0xFFFF).to_bytes(2, "big" if self.family.big else "little")

    # What it does

    def velocity(self) -> float:
        """Steps/s by its words, in a mode that turns."""
        if self.mode == "velocity":
            return self.word(SPEED, 15) * self._speed_unit()
        return self.word(PWM, 10) / 1000 * FULL_SPEED if self.mode in ("pwm", "motor") else 0.0

    def _speed_unit(self) -> int:
        return 1 if self.family.big or self.memory[PHASE] & 4 else 50

    def target(self) -> float:
        """Where position and step mode drive to: never outside the stored limits, where there are any."""
        if self.mode == "step":
            return self._target
        goal, limits = self.word(GOAL, 0 if self.family.big else 15), (self.word(MIN_LIMIT), self.word(MAX_LIMIT))
        return min(max(goal, limits[0]), limits[1]) if any(limits) else goal

    def advance(self, now: float) -> None:
        if now < self.off_until or not self.memory[TORQUE]:
            self.joint.hang(now)
        elif self.mode in ("position", "step"):
            self.joint.go(now, self.target(), self.word(SPEED, 15) * self._speed_unit() or FULL_SPEED)
        else:
            self.joint.turn(now, self.velocity())

    def moves(self) -> bool:
        if not self.memory[TORQUE]:
            return False
        return bool(self.velocity()) or (self.mode in ("position", "step") and abs(self.target() - self.joint.position) > 0.5)

    def driven(self) -> float:
        return self.joint.driven

    def cut_power(self, now: float, seconds: float) -> None:
        self.advance(now)
        self.off_until = now + seconds + BOOT
        self._start()

    def trip(self) -> None:
        """Its protection switches torque off."""
        self.memory[TORQUE] = 0
        self.memory[STATUS] |= OVERLOAD

    # Its memory from outside

    def read(self, address: int, size: int) -> bytes:
        wrong = 0
        if address <= POSITION < address + size:
            wrong = self.lies.get(self.position_reads, 0)
            self.position_reads += 1
        self.put(POSITION, round(self.joint.position) + wrong, 15)
        self.memory[MOVING] = self.moves()
        self.memory[FLAG] = self.armed is not None
        if not self.family.big:
            self.put(GOAL_NOW, round(self.target()), 15)
        return bytes(self.memory[address : address + size])

    def write(self, address: int, data: bytes, now: float) -> None:
        before = self.memory[TORQUE]
        self.memory[address : address + len(data)] = data
        if address <= GOAL < address + len(data):
            if address > TORQUE:
                self.memory[TORQUE] = 1
            if self.mode == "step":
                self._target = self.joint.position + self.word(GOAL, 15)
        if self.memory[TORQUE] and not before:
            self.energised_at.append(now)
            self.memory[STATUS] = 0

    def carry_out(self, now: float) -> None:
        """ACTION."""
        if self.armed is not None:
            (address, data), self.armed = self.armed, None
            self.fired += 1
            self.write(address, data, now)


class SmsLine(WitnessLine):
    """A line of SMS 1.0: FF FF id length instruction parameters sum."""

    servos: dict[int, SmsServo]  # type: ignore[assignment]

    def __init__(self, servos: Sequence[SmsServo], *, baudrate: int = 1_000_000, rng: random.Random) -> None:
        super().__init__(servos, baudrate=baudrate, rng=rng)

    def size_of(self, data: bytes) -> int:
        if len(data) < 4:
            return 0 if data[:2] == b"\xff\xff"[: len(data)] else -1
        size = data[3] + 4
        if data[:2] != b"\xff\xff" or data[2] == 0xFF or size < 6:
            return -1
        if len(data) < size:
            return 0
        return size if (~sum(data[2 : size - 1])) & 0xFF == data[size - 1] else -1

    def answers(self, frame: bytes, now: float) -> Iterator[tuple[int, bytes]]:
        node, code, params = frame[2], frame[4], frame[5:-1]
        if code == SYNC_READ:
            for each in params[2:]:
                yield from self._one(each, READ, params[:2], now)
        elif code == SYNC_WRITE:
            address, size = params[0], params[1]
            for at in range(2, len(params), size + 1):
                list(self._one(params[at], WRITE, bytes((address,)) + params[at + 1 : at + 1 + size], now))
        elif node == ALL:
            for each in self.servos:
                list(self._one(each, code, params, now))
        else:
            yield from self._one(node, code, params, now)

    def _one(self, node: int, code: int, params: bytes, now: float) -> Iterator[tuple[int, bytes]]:
        servo = self.servos.get(node)
        if servo is None or not servo.receives(now, self.rng):
            return
        servo.advance(now)
        data = b""
        if code == READ:
            data = servo.read(params[0], params[1])
        elif code == WRITE:
            servo.write(params[0], params[1:], now)
        elif code == REG_WRITE:
            servo.armed = params[0], params[1:]
        elif code == ACTION:
            servo.carry_out(now)
        if servo.replies(now, self.rng) and (code in (PING, READ) or servo.memory[RESPONSE_LEVEL]):
            yield node, status(node, servo.memory[STATUS], data)


def status(node: int, error: int, data: bytes = b"") -> bytes:
    """A status frame with its sum."""
    content = bytes((node, len(data) + 2, error)) + data
    return b"\xff\xff" + content + bytes(((~sum(content)) & 0xFF,))


def instruction(node: int, code: int, *params: int) -> bytes:
    """A frame of another master."""
    return status(node, code, bytes(params))
