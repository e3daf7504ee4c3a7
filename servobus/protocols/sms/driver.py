"""The FEETECH driver: the requests of each verb (SMS 1.0; FEETECH memory tables). Sans-IO.

The parts: `identity` (and what it learns), `reading` (state, polls, registers), `settings` (writes by name), `goals` and `packer`
(motion), `enable`, `stop`, `armed` (REG WRITEs that wait).
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Mapping, Sequence
from typing import Any

from servobus.errors import ReplyTimeout
from servobus.protocols.base import Driver, GoalPlan, Plan, Poll, Request, ask
from servobus.protocols.fence import fence
from servobus.protocols.sms.armed import Armed
from servobus.protocols.sms.codec import MAX_ID
from servobus.protocols.sms.enable import Enabler
from servobus.protocols.sms.goals import GoalWriter
from servobus.protocols.sms.identity import identify, inspect
from servobus.protocols.sms.model import SmsModel
from servobus.protocols.sms.options import SmsBus
from servobus.protocols.sms.packer import PackedGoal
from servobus.protocols.sms.reading import Reader
from servobus.protocols.sms.requests import Fence, Ping
from servobus.protocols.sms.servo import HostServo
from servobus.protocols.sms.settings import SettingWriter
from servobus.protocols.sms.stop import Stopper
from servobus.values import Identity, Loss, ServoGoal, StopReport, StopTarget, Update

FENCE_SIZES = range(3, 27)
"""Lengths of a fence's READ, which are the keys of its replies. Never two bytes: the echo of a READ has two parameters."""


class SmsDriver(Driver):
    """See `protocols.base.Driver`."""

    def __init__(self, options: SmsBus, models: Mapping[str, SmsModel]) -> None:
        self.options = options
        self.servos = {name: HostServo(name, servo, models[servo.model]) for name, servo in options.servos.items()}
        self.nodes = {name: servo.node for name, servo in self.servos.items()}
        self._servo_at = {servo.node: servo for servo in self.servos.values()}
        self._armed = Armed(self.servos)
        self._settings = SettingWriter()
        self._take(options)

    def _take(self, options: SmsBus) -> None:
        """Make the parts that follow from the options."""
        for servo in self.servos.values():
            if servo.fit.response_level is None:
                servo.answers_writes = options.writes_answered
        self.options = options
        self._reader = Reader(options, self.servos)
        self._goals = GoalWriter(options, self.servos, self._armed)
        self._stopper = Stopper(options, self._armed)

    def use_options(self, options: SmsBus) -> bool:
        """Take other rates, limits, speeds and policies; ids, models and calibrations are as they were."""
        for name, servo in self.servos.items():
            servo.options = options.servos[name]
        self._take(options)
        return True

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
        if servo is None:
            return True
        self._armed.suspect(node)
        if not enabled:
            return True
        return (yield from _keeps_sentinel(servo))

    def inspect(self, node: int) -> Plan[Identity]:
        return inspect(node, self._armed)

    def identify(self, servo: str) -> Plan[Identity]:
        return identify(self.servos[servo], self.options, self._armed)

    # Reading and writing

    def read_state(self, servo: str) -> Request[dict[str, Update]]:
        return self._reader.state(servo)

    def polls(self, rates: Mapping[str, float]) -> Sequence[Poll]:
        return self._reader.polls(rates)

    def read_register(self, servo: str, register: str, *, raw: bool = False) -> Request[Any]:
        made = self.servos[servo].reads.get((register, raw))
        return self._reader.register(servo, register, raw=raw) if made is None else made

    def write_register(self, servo: str, register: str, value: Any, *, raw: bool = False, persist: bool = False) -> Plan[Any]:
        return self._settings.write(self.servos[servo], register, value, raw=raw, persist=persist)

    def fault_names(self, servo: str, status: int | None) -> tuple[str, ...]:
        return self.servos[servo].model.fault_names(status)

    # Motion

    def step(self, servo: str) -> float:
        return self.servos[servo].calibration.unit_per_step

    def enable(self, servo: str) -> Plan[float | None]:
        """Settings, goal := present, torque on, read back. An enable that fails half-way ends with torque off."""
        return Enabler(self.servos[servo], self._goals.packers[servo], self._armed).plan()

    def disable(self, servo: str) -> Plan[StopReport]:
        return self._stopper.disable(self.servos[servo])

    def stop(self, targets: Sequence[StopTarget]) -> Plan[dict[str, StopReport]]:
        return self._stopper.stop([(self.servos[target.servo], target) for target in targets])

    def verify(self, servos: Sequence[str]) -> Plan[Mapping[str, Loss]]:
        return self._reader.verify(servos)

    def blind_stop(self, target: StopTarget) -> Sequence[Request[Any]]:
        return self._stopper.blind(self.servos[target.servo], target)

    def preview_stop(self, targets: Sequence[StopTarget]) -> Sequence[Request[Any]]:
        return self._stopper.preview([(self.servos[target.servo], target) for target in targets])

    def check_goal(self, goal: ServoGoal) -> PackedGoal:
        return self._goals.check(goal)

    def plan_goals(self, goals: Sequence[ServoGoal], *, together: bool, confirm: bool) -> Sequence[GoalPlan]:
        return self._goals.plan(goals, together=together, confirm=confirm)

    def preview_goals(self, goals: Sequence[ServoGoal]) -> Sequence[Request[Any]]:
        return self._goals.preview(goals)


def _keeps_sentinel(servo: HostServo) -> Plan[bool]:
    """Whether the servo has not restarted since it was enabled. A lost reply is asked for once more, with another length."""
    name, reset = servo.model.sentinel.name, servo.model.sentinel.reset
    try:
        registers = yield from ask(servo.read_registers((name,)))
    except ReplyTimeout:
        registers = yield from ask(servo.read_registers((name,), more=2))
    return registers[name] != reset
