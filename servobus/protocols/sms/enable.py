"""How a FEETECH servo is enabled: goal := present, torque on, all of it read back, and the joint does not move.

The order:
1. Read only. The servo's settings (`identity.learn`), its torque, what it holds beside the goal, and whether a REG WRITE waits in
   it. It is refused where the joint would move: an obstacle, or a joint that stands outside the servo's stored limits.
2. What waits in it is disarmed; acceleration and torque limit are written where they are not right.
3. The present position is read twice, with replies of different length, so that one altered reply is not believed. Two readings
   that differ ask for a third; a joint that moves is refused.
4. Goal := present, and both are read and compared. This frame is never repeated as it is, because a limp joint may have sagged
   meanwhile: a lost reply leads back to 3. So does a joint that is not at its goal.
5. Torque on; then torque, goal and present are read back.

Writing the goal position switches torque on by itself (measured on STS3215, in public by several clients), so 4 is written last.
From 2 on, an enable that fails ends with torque off.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress

from servobus.errors import DeviceError, NotSupported, ReplyTimeout, ServobusError
from servobus.protocols.base import Plan, ask
from servobus.protocols.sms.armed import Armed
from servobus.protocols.sms.identity import learn
from servobus.protocols.sms.model import LIMITS
from servobus.protocols.sms.packer import GoalPacker
from servobus.protocols.sms.requests import Write, WriteOnce
from servobus.protocols.sms.servo import TORQUE_ON, HostServo

TRIES = 3
NOISE_STEPS = 8
"""Steps by which two readings of a joint at rest may differ: noise, and what a limp arm sags meanwhile."""
SETTINGS = ("acceleration", "torque_limit")
"""Registers beside the goal that a goal may change."""


class Enabler:
    """The plan that enables one servo."""

    def __init__(self, servo: HostServo, packer: GoalPacker, armed: Armed) -> None:
        self._servo = servo
        self._packer = packer
        self._armed = armed
        model = servo.model
        self._torque = model.registers[model.torque]
        self._present = model.registers[model.state["position"]]

    def plan(self) -> Plan[float | None]:
        """Return the plan. Its value is the present position in the servo's unit; None where it turns at a velocity."""
        servo = self._servo
        yield from learn(servo)
        if servo.takes is None:
            raise NotSupported(f"it is not enabled: {servo.fit.obstacle}", servo=servo.name)
        self._armed.suspect(servo.node)
        obstacle = yield from self._outside()
        if obstacle:
            raise NotSupported(obstacle, servo=servo.name)
        before = yield from self._settings()
        try:
            if servo.node in self._armed and not (yield from self._is_disarmed()):
                raise DeviceError("a REG WRITE waits in it, and it could not be disarmed: switch its power off", servo=servo.name)
            yield from self._prepare(before)
            return (yield from (self._hold() if servo.takes == "position" else self._rest()))
        except ServobusError:
            with suppress(ServobusError):
                yield from ask(Write(servo.node, self._torque.address, b"\x00", answered=self._servo.answers_writes))
            raise

    # Before anything is written

    def _outside(self) -> Plan[str]:
        """Return why torque would make the joint travel; empty: it stands inside its stored limits."""
        servo, limits = self._servo, self._servo.fit.raw_limits
        if limits is None or servo.takes != "position":
            return ""
        present = yield from self._position()
        if limits[0] <= present <= limits[1]:
            return ""
        low, high = servo.limits or (0.0, 0.0)
        return (
            f"it is not enabled: the joint is at {servo.calibration.to_unit(present):.4g}, outside the servo's own stored limits "
            f"{low:.4g} to {high:.4g}, and torque would drive it there. Turn it inside by hand, or write {' and '.join(LIMITS)}"
        )

    def _settings(self) -> Plan[dict[str, int]]:
        """Read what the servo holds beside the goal, and keep what is its own: not what our last goal left there."""
        servo = self._servo
        names = [name for name in SETTINGS if name in servo.model.registers]
        if not names:
            return {}
        registers = yield from ask(servo.read_registers(names))
        own = {name: raw for name, raw in registers.items() if servo.held.get(name) != raw or name not in servo.own}
        sentinel = servo.model.sentinel
        if own.get(sentinel.name) == sentinel.reset:
            own[sentinel.name] = sentinel.value
        servo.own = {**servo.own, **own}
        return registers

    # What is written

    def _is_disarmed(self) -> Plan[bool]:
        flag = yield from self._armed.flag(self._servo.node)
        return not flag or (yield from self._armed.disarm(self._servo))

    def _prepare(self, before: Mapping[str, int]) -> Plan[None]:
        servo = self._servo
        servo.held = before
        for name, raw in self._packer.settings(None, None).items():
            if before.get(name) != raw:
                servo.forget({name: raw})
                register = servo.model.registers[name]
                yield from ask(Write(servo.node, register.address, servo.encode(register, raw), answered=servo.answers_writes))
                servo.hold({name: raw})

    def _hold(self) -> Plan[float]:
        """Hold the joint where it stands; return where."""
        servo = self._servo
        for _ in range(TRIES):
            present = yield from self._position()
            try:
                yield from self._write_once(*self._packer.first_goal(present))
                if not (yield from self._stands_at(present)):
                    continue
                yield from self._write_once(self._torque.address, bytes((TORQUE_ON,)))
            except ReplyTimeout:
                continue
            if (yield from self._stands_at(present, torque=TORQUE_ON)):
                return servo.calibration.to_unit(present)
        raise DeviceError("the servo did not take its present position as goal: it stays disabled", servo=servo.name)

    def _rest(self) -> Plan[None]:
        """Speed 0, then torque on."""
        servo, torque = self._servo, self._servo.model.torque
        yield from self._write_once(*self._packer.first_goal(0))
        yield from self._write_once(self._torque.address, bytes((TORQUE_ON,)))
        registers = yield from ask(servo.read_registers((torque, servo.speed.name)))
        if registers != {torque: TORQUE_ON, servo.speed.name: 0}:
            raise DeviceError("the servo did not take speed 0: it stays disabled", servo=servo.name)

    def _write_once(self, address: int, data: bytes) -> Plan[None]:
        """Write, and never repeat it: the joint may have moved meanwhile."""
        yield from ask(WriteOnce(self._servo.node, address, data, answered=self._servo.answers_writes))

    # What is read

    def _stands_at(self, goal: int, torque: int | None = None) -> Plan[bool]:
        """Whether the servo has this goal, stands there, and has this torque."""
        servo = self._servo
        registers = yield from ask(servo.read_registers((self._torque.name, servo.position.name, self._present.name)))
        right = torque is None or registers[self._torque.name] == torque
        return right and registers[servo.position.name] == goal and abs(registers[self._present.name] - goal) <= NOISE_STEPS

    def _position(self) -> Plan[int]:
        """Return the present position, when two readings agree. A limp joint that moves is refused with DeviceError.

        One that is energised and moves is held where it was between three readings, and comes to rest there.
        """
        readings: list[int] = []
        torque = 0
        for more in range(1, TRIES + 1):
            registers = yield from ask(self._servo.read_registers((self._torque.name, self._present.name), more=more))
            torque, present = registers[self._torque.name], registers[self._present.name]
            if any(abs(present - reading) <= NOISE_STEPS for reading in readings):
                return present
            readings.append(present)
        if torque == TORQUE_ON:
            return sorted(readings)[1]
        text = ", ".join(f"{self._servo.calibration.to_unit(reading):.4g}" for reading in readings)
        raise DeviceError(f"its position reads {text} within a moment: the joint moves. Hold it still", servo=self._servo.name)
