"""The FEETECH driver: what to say for each verb (seed 1.3, 1.4; feetech.md). Sans-IO."""

from __future__ import annotations

import re
from collections.abc import Collection, Hashable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

from servobus.errors import DeviceError, LimitError, NotSupported, ServobusError, UnknownName
from servobus.protocols.base import Driver, GoalPlan, Plan, Poll, Request, ask
from servobus.protocols.model import Register
from servobus.protocols.sms.codec import MAX_ID
from servobus.protocols.sms.goals import MAX_FRAME_SECONDS, GoalWriter
from servobus.protocols.sms.identity import identify, inspect, learn_mode
from servobus.protocols.sms.model import SmsModel
from servobus.protocols.sms.options import SmsBus
from servobus.protocols.sms.requests import Fence, Ping, Read, SyncRead, Write
from servobus.protocols.sms.servo import FittedServo
from servobus.protocols.sms.stop import Stopper
from servobus.values import Identity, ServoGoal, StopReport, StopTarget, Update

FENCE_SIZES = range(3, 27)
"""Never two parameters: the echo of any READ has two."""
FENCE_TRIES = 2
COMMISSIONING = frozenset({"id", "baud_rate", "response_status_level"})
"""Registers whose change makes the config untrue and loses the servo."""
SPAN = re.compile(r"(0[xX][0-9a-fA-F]+|\d+):(\d+)")


class SmsDriver(Driver):
    """See `protocols.base.Driver`."""

    def __init__(self, options: SmsBus, models: Mapping[str, SmsModel]) -> None:
        self.options = options
        self.servos = {name: FittedServo(name, servo, models[servo.model]) for name, servo in options.servos.items()}
        self.by_node = {servo.node: servo for servo in self.servos.values()}
        self.nodes = {name: servo.node for name, servo in self.servos.items()}
        self._reads: dict[tuple[str, str, bool], Request[Any]] = {}
        """Requests are immutable, and the same few registers are read again and again."""
        self._writer = GoalWriter(options)
        self._stopper = Stopper(options)

    @property
    def acknowledged(self) -> bool:
        return self._writer.acknowledged

    def step(self, servo: str) -> float:
        return self.servos[servo].calibration.unit_per_step

    # Who is there

    def ping(self, node: int) -> Request[int | None]:
        return Ping(node)

    def unused(self) -> Request[Any]:
        free = (node for node in range(MAX_ID, -1, -1) if node not in self.by_node)
        return Ping(next(free))

    def fence(self, node: int, avoid: Sequence[Hashable], enabled: Collection[str]) -> Plan[bool]:
        used = list(avoid)
        for attempt in range(FENCE_TRIES):
            size = fence_size(used)
            try:
                yield from ask(Fence(node, size))
                break
            except ServobusError:
                if attempt == FENCE_TRIES - 1:
                    raise
                used.append(size)
        servo = self.by_node.get(node)
        if servo is None or not enabled:
            return True
        sentinel = servo.model.sentinel
        return (yield from ask(self._read(servo, servo.model.registers[sentinel.name]))) != sentinel.reset

    def inspect(self, node: int) -> Plan[Identity]:
        return inspect(node)

    def identify(self, servo: str) -> Plan[Identity]:
        return identify(self.servos[servo], self.options)

    # Reading

    def read_state(self, servo: str) -> Request[dict[str, Update]]:
        fitted = self.servos[servo]
        address, size = fitted.model.block(*fitted.model.health)
        return Read(fitted.node, address, size, lambda data: {servo: fitted.decode_state(data)})

    def polls(self, rates: Mapping[str, float]) -> Sequence[Poll]:
        return [poll for name, hz in rates.items() for poll in self._polls(name, hz)]

    def _polls(self, name: str, hz: float) -> Sequence[Poll]:
        """SYNC READ for the servos that know it and share a block, one READ for each of the others."""
        groups: dict[tuple[int, int, int], list[FittedServo]] = {}
        for servo in self.servos.values():
            block = servo.model.block(*(servo.model.feedback if name == "feedback" else servo.model.health))
            alone = 0 if servo.model.sync_read else servo.node + 1
            groups.setdefault((*block, alone), []).append(servo)
        polls = []
        for (address, size, _), servos in groups.items():
            most = max(1, int(MAX_FRAME_SECONDS * self.options.baudrate / 10) // (size + 6))
            for start in range(0, len(servos), most):
                members = servos[start : start + most]
                nodes = tuple(servo.node for servo in members)
                polls.append(Poll(name, hz, nodes, partial(self._poll_request, name, address, size, members)))
        return polls

    def _poll_request(
        self, name: str, address: int, size: int, servos: Sequence[FittedServo], reachable: Collection[int]
    ) -> Request[dict[str, Update]] | None:
        here = {servo.node: servo for servo in servos if servo.node in reachable}

        def decode(data: Mapping[int, bytes]) -> dict[str, Update]:
            found = ((here[node], part) for node, part in data.items())
            return {
                servo.name: servo.decode_feedback(part) if name == "feedback" else servo.decode_state(part)
                for servo, part in found
            }

        if not here:
            return None
        if len(here) == 1:
            node = next(iter(here))
            return Read(node, address, size, lambda data: decode({node: data}))
        return SyncRead(address, size, list(here), decode)

    def read_register(self, servo: str, register: str, *, raw: bool = False) -> Request[Any]:
        known = self._reads.get((servo, register, raw))
        if known is not None:
            return known
        fitted = self.servos[servo]
        if match := SPAN.fullmatch(register):
            return self._read_span(fitted, int(match[1], 0), int(match[2]))
        request = self._reads[servo, register, raw] = self._read_named(fitted, fitted.model.readable(register), raw)
        return request

    def _read_named(self, servo: FittedServo, register: Register, raw: bool) -> Request[Any]:
        if raw:
            return self._read(servo, register)
        return Read(
            servo.node, register.address, register.size, lambda data: servo.to_physical(register, servo.decode(register, data))
        )

    @staticmethod
    def _read_span(servo: FittedServo, address: int, size: int) -> Read[list[int]]:
        if not (0 <= address <= 255 and 1 <= size <= 250 and address + size <= 256):
            raise LimitError(f"{address}:{size} is no span of the memory table: give ADDR:LEN within 0:256", servo=servo.name)
        return Read(servo.node, address, size, list)

    @staticmethod
    def _read(servo: FittedServo, register: Register) -> Read[int]:
        return Read(servo.node, register.address, register.size, lambda data: servo.decode(register, data))

    # Writing

    def write_register(self, servo: str, register: str, value: Any, *, raw: bool = False, persist: bool = False) -> Plan[Any]:
        fitted = self.servos[servo]
        found = fitted.model.writable(register)
        self._refuse(fitted, found, persist)
        count = value if raw else fitted.to_raw(found, value)
        if raw and (isinstance(value, bool) or not isinstance(value, int)):
            raise LimitError(f"register {found.name}: a raw value is an integer, found {value!r}", servo=servo)
        data = fitted.encode(found, count)
        sentinel = fitted.model.sentinel
        if found.name == sentinel.name and count == sentinel.reset:
            raise LimitError(
                f"register {found.name}: {count} is what a restart leaves there, and how a restart is noticed; write "
                f"{sentinel.value} instead",
                servo=servo,
            )
        return self._write_plan(fitted, found, data, count, raw=raw)

    def _refuse(self, servo: FittedServo, register: Register, persist: bool) -> None:
        """Registers that other verbs own, and EEPROM without the word for it."""
        if register.name in (*servo.model.goal, servo.model.torque, servo.model.lock):
            verb = (
                "move"
                if register.name in servo.model.goal
                else "enable or disable"
                if register.name == servo.model.torque
                else ""
            )
            hint = f"use {verb}" if verb else "an EEPROM write unlocks and locks by itself"
            raise NotSupported(f"register {register.name} is not written by hand: {hint}", servo=servo.name)
        if register.name in COMMISSIONING:
            raise NotSupported(
                f"register {register.name} is not written while the bus runs: the config would no longer find the servo",
                servo=servo.name,
            )
        if register.memory == "eeprom" and not persist:
            raise NotSupported(
                f"register {register.name} is kept in EEPROM: say persist (--persist) to wear it", servo=servo.name
            )

    def _write_plan(self, servo: FittedServo, register: Register, data: bytes, count: int, *, raw: bool) -> Plan[Any]:
        if register.memory == "eeprom":
            yield from self._write_eeprom(servo, register, data)
        else:
            yield from ask(Write(servo.node, register.address, data, answered=self.acknowledged))
        if register.memory == "eeprom" or not self.acknowledged:
            found = yield from ask(self._read(servo, register))
            if found != count:
                raise DeviceError(
                    f"register {register.name} reads {found} after {count} was written: the servo did not take it",
                    servo=servo.name,
                )
        if register.name in servo.extras:
            servo.extras[register.name] = count
        return count if raw else servo.to_physical(register, count)

    def _write_eeprom(self, servo: FittedServo, register: Register, data: bytes) -> Plan[None]:
        """Unlock, write, lock again whatever happened (seed 1.3.3: unlocked, or the value is lost at power-off)."""
        lock = servo.model.registers[servo.model.lock].address
        if (yield from ask(self._read(servo, servo.model.registers[servo.model.torque]))):
            raise NotSupported(
                "its torque is on, and EEPROM is written to servos at rest only: disable it first", servo=servo.name
            )
        try:
            yield from ask(Write(servo.node, lock, b"\x00", answered=self.acknowledged))
            yield from ask(Write(servo.node, register.address, data, answered=self.acknowledged))
        except ServobusError:
            yield from ask(Write(servo.node, lock, b"\x01", answered=self.acknowledged))
            raise
        yield from ask(Write(servo.node, lock, b"\x01", answered=self.acknowledged))

    # Motion

    def enable(self, servo: str) -> Plan[float | None]:
        """Mode, sentinel and limits, goal := present, torque on, all read back. What fails half-way ends with torque off."""
        fitted = self.servos[servo]
        yield from learn_mode(fitted)
        try:
            return (yield from self._energise(fitted))
        except ServobusError:
            torque = fitted.model.registers[fitted.model.torque]
            with suppress(ServobusError):
                yield from ask(Write(fitted.node, torque.address, b"\x00", answered=self.acknowledged))
            raise

    def _energise(self, fitted: FittedServo) -> Plan[float | None]:
        model = fitted.model
        fitted.extras.clear()
        for name, count in fitted.extras_for(None, None).items():
            register = model.registers[name]
            yield from ask(Write(fitted.node, register.address, fitted.encode(register, count), answered=self.acknowledged))
            fitted.extras[name] = count
        present = yield from ask(self._read(fitted, model.registers[model.state["position"]]))
        goal = 0 if fitted.mode == "velocity" else present
        register = fitted.speed if fitted.mode == "velocity" else fitted.position
        yield from ask(Write(fitted.node, *self._first_goal(fitted, goal), answered=self.acknowledged))
        torque = model.registers[model.torque]
        yield from ask(Write(fitted.node, torque.address, b"\x01", answered=self.acknowledged))
        if (yield from ask(self._read(fitted, register))) != goal or not (yield from ask(self._read(fitted, torque))):
            raise DeviceError("the servo did not take its present position as goal: it stays disabled", servo=fitted.name)
        return fitted.calibration.to_unit(present) if fitted.mode == "position" else None

    @staticmethod
    def _first_goal(servo: FittedServo, goal: int) -> tuple[int, bytes]:
        if servo.mode == "velocity":
            return servo.speed.address, servo.encode(servo.speed, goal)
        words = ((servo.position, goal), (servo.time, servo.rest_time()), (servo.speed, servo.default_speed()))
        return servo.position.address, b"".join(servo.encode(register, word) for register, word in words)

    def disable(self, servo: str) -> Plan[StopReport]:
        return self._stopper.disable(self.servos[servo])

    def stop(self, targets: Sequence[StopTarget]) -> Plan[dict[str, StopReport]]:
        return self._stopper.stop([(self.servos[target.servo], target) for target in targets])

    def check_goal(self, goal: ServoGoal) -> None:
        if goal.servo not in self.servos:
            raise UnknownName(f"no servo {goal.servo} on this bus")
        start = goal if goal.start is not None else ServoGoal(goal.servo, goal.goal, goal.goal.value)
        self.servos[goal.servo].goal_span(start)

    def host_speed(self, goal: ServoGoal) -> float | None:
        """The servo keeps the speed that stands beside its goal."""
        return None

    def plan_goals(self, goals: Sequence[ServoGoal], *, together: bool, confirm: bool) -> Sequence[GoalPlan]:
        return self._writer.plan([(self.servos[goal.servo], goal) for goal in goals], together=together, confirm=confirm)

    def fault_names(self, servo: str, status: int | None) -> tuple[str, ...]:
        return self.servos[servo].model.fault_names(status)


def fence_size(avoid: Sequence[Hashable]) -> int:
    """A READ length that no reply still under way can have; when all are taken, the oldest (`avoid` is oldest first)."""
    free = (size for size in FENCE_SIZES if size not in avoid)
    oldest = (key for key in avoid if isinstance(key, int) and key in FENCE_SIZES)
    return next(free, None) or next(oldest)
