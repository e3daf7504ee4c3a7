"""The FEETECH driver: the requests of each verb (SMS 1.0; FEETECH memory tables). Sans-IO.

The parts: `reading` (state, polls, registers), `settings` (writes by name), `goals` and `packer` (motion), `stop`, `identity`.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Mapping, Sequence
from contextlib import suppress
from typing import Any

from servobus.errors import DeviceError, ServobusError
from servobus.protocols.base import Driver, GoalPlan, Plan, Poll, Request, ask
from servobus.protocols.fence import fence
from servobus.protocols.sms.codec import MAX_ID
from servobus.protocols.sms.goals import GoalWriter
from servobus.protocols.sms.identity import identify, inspect, learn_mode
from servobus.protocols.sms.model import SmsModel
from servobus.protocols.sms.options import SmsBus
from servobus.protocols.sms.packer import PackedGoal
from servobus.protocols.sms.reading import Reader
from servobus.protocols.sms.requests import Fence, Ping, Write
from servobus.protocols.sms.servo import HostServo
from servobus.protocols.sms.settings import SettingWriter
from servobus.protocols.sms.stop import Stopper
from servobus.values import Identity, ServoGoal, StopReport, StopTarget, Update

FENCE_SIZES = range(3, 27)
"""Lengths of a fence's READ, which are the keys of its replies. Never two bytes: the echo of a READ has two parameters."""


class SmsDriver(Driver):
    """See `protocols.base.Driver`."""

    def __init__(self, options: SmsBus, models: Mapping[str, SmsModel]) -> None:
        self.options = options
        self.servos = {name: HostServo(name, servo, models[servo.model]) for name, servo in options.servos.items()}
        self.nodes = {name: servo.node for name, servo in self.servos.items()}
        self._servo_at = {servo.node: servo for servo in self.servos.values()}
        self._reader = Reader(options, self.servos)
        self._settings = SettingWriter(options)
        self._goals = GoalWriter(options, self.servos)
        self._stopper = Stopper(options)

    # Addressing

    def ping(self, node: int) -> Request[int | None]:
        return Ping(node)

    def unused(self) -> Request[Any]:
        free = (node for node in range(MAX_ID, -1, -1) if node not in self._servo_at)
        return Ping(next(free))

    def fence(self, node: int, avoid: Sequence[Hashable], enabled: Collection[str]) -> Plan[bool]:
        """A READ of a length that no reply under way has; then the sentinel, where the servo is enabled."""
        yield from fence(lambda size: ask(Fence(node, size)), FENCE_SIZES, avoid)
        servo = self._servo_at.get(node)
        if servo is None or not enabled:
            return True
        sentinel = servo.model.sentinel
        return (yield from ask(servo.read_raw(servo.model.registers[sentinel.name]))) != sentinel.reset

    def inspect(self, node: int) -> Plan[Identity]:
        return inspect(node)

    def identify(self, servo: str) -> Plan[Identity]:
        return identify(self.servos[servo], self.options)

    # Reading and writing

    def read_state(self, servo: str) -> Request[dict[str, Update]]:
        return self._reader.state(servo)

    def polls(self, rates: Mapping[str, float]) -> Sequence[Poll]:
        return self._reader.polls(rates)

    def read_register(self, servo: str, register: str, *, raw: bool = False) -> Request[Any]:
        made = self._reader.registers.get((servo, register, raw))
        return self._reader.register(servo, register, raw=raw) if made is None else made

    def write_register(self, servo: str, register: str, value: Any, *, raw: bool = False, persist: bool = False) -> Plan[Any]:
        return self._settings.write(self.servos[servo], register, value, raw=raw, persist=persist)

    def fault_names(self, servo: str, status: int | None) -> tuple[str, ...]:
        return self.servos[servo].model.fault_names(status)

    # Motion

    def step(self, servo: str) -> float:
        return self.servos[servo].calibration.unit_per_step

    def enable(self, servo: str) -> Plan[float | None]:
        """Mode, settings, goal := present, torque on, read back. An enable that fails half-way ends with torque off."""
        host = self.servos[servo]
        yield from learn_mode(host)
        try:
            return (yield from self._energise(host))
        except ServobusError:
            with suppress(ServobusError):
                yield from ask(self._torque(host, b"\x00"))
            raise

    def _energise(self, servo: HostServo) -> Plan[float | None]:
        model, packer = servo.model, self._goals.packers[servo.name]
        velocity = servo.fit.mode == "velocity"
        servo.held = {}
        for name, raw in packer.settings(None, None).items():
            register = model.registers[name]
            yield from ask(self._settings.request(servo, register, servo.encode(register, raw)))
            servo.hold({name: raw})
        present = yield from ask(servo.read_raw(model.registers[model.state["position"]]))
        register, goal = (servo.speed, 0) if velocity else (servo.position, present)
        yield from ask(Write(servo.node, *packer.first_goal(present), answered=self.options.writes_answered))
        yield from ask(self._torque(servo, b"\x01"))
        taken = (yield from ask(servo.read_raw(register))) == goal
        if not (taken and (yield from ask(servo.read_raw(model.registers[model.torque])))):
            raise DeviceError("the servo did not take its present position as goal: it stays disabled", servo=servo.name)
        return None if velocity else servo.calibration.to_unit(present)

    def _torque(self, servo: HostServo, data: bytes) -> Write:
        return self._settings.request(servo, servo.model.registers[servo.model.torque], data)

    def disable(self, servo: str) -> Plan[StopReport]:
        return self._stopper.disable(self.servos[servo])

    def stop(self, targets: Sequence[StopTarget]) -> Plan[dict[str, StopReport]]:
        return self._stopper.stop([(self.servos[target.servo], target) for target in targets])

    def preview_stop(self, targets: Sequence[StopTarget]) -> Sequence[Request[Any]]:
        return self._stopper.preview([(self.servos[target.servo], target) for target in targets])

    def check_goal(self, goal: ServoGoal) -> PackedGoal:
        return self._goals.check(goal)

    def plan_goals(self, goals: Sequence[ServoGoal], *, together: bool, confirm: bool) -> Sequence[GoalPlan]:
        return self._goals.plan(goals, together=together, confirm=confirm)

    def preview_goals(self, goals: Sequence[ServoGoal]) -> Sequence[Request[Any]]:
        return self._goals.preview(goals)
