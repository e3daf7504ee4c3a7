"""The KST driver: which requests each verb takes (KST RS422, 3). Sans-IO. Written from the document, not tried on hardware yet.

The protocol has no ping, torque, stop or speed command. So a ping reads the id, `enable` writes nothing and only lets goals pass,
a stop sends a position to hold, and the host keeps the speed (`host_speed`).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from servobus.errors import DeviceError, LimitError, NotSupported, ReplyTimeout, UnknownName
from servobus.protocols import fence
from servobus.protocols.base import Driver, GoalPlan, Plan, Poll, Request, ask, single_polls
from servobus.protocols.kst import goals, identity
from servobus.protocols.kst.codec import Command, version_text
from servobus.protocols.kst.commissioning import KstCommissioning
from servobus.protocols.kst.model import KstModel
from servobus.protocols.kst.options import KstBus
from servobus.protocols.kst.position import locate, position_read
from servobus.protocols.kst.requests import Fence, Read, RequestSettings
from servobus.protocols.kst.servo import CalibratedServo
from servobus.protocols.speed import goal_speed
from servobus.values import Identity, Loss, ServoGoal, StopReport, StopTarget, Update

FENCES = (Command.READ_ID, Command.READ_VERSION, Command.READ_STATUS, Command.READ_POSITION)
"""The reads that can be a fence, the preferred one first: its reply also has the servo's id in the data."""
OTHER_VERBS = {"goal_position": "use move", "id": "use commissioning (set_id)", "baud_rate": "use commissioning (set_baudrate)"}
"""Register -> the verb that writes it."""


class KstDriver(Driver):
    """The driver of a KST bus; see `protocols.base.Driver`."""

    commissioning: KstCommissioning

    def __init__(self, options: KstBus, models: Mapping[str, KstModel]) -> None:
        self.options = options
        self.servos = {name: CalibratedServo(name, servo, models[servo.model]) for name, servo in options.servos.items()}
        self.by_node = {servo.node: servo for servo in self.servos.values()}
        self.nodes = {name: servo.node for name, servo in self.servos.items()}
        self.settings = RequestSettings.of(options)
        self.commissioning = KstCommissioning(options, self.settings)
        # Requests are immutable, so each is made once.
        self._state_reads = {
            (name, part): self._state_read(name, part) for name in self.servos for part in ("feedback", "health")
        }
        self._reads: dict[tuple[str, str, bool], Request[Any]] = {}

    def use_options(self, options: KstBus) -> bool:
        if not self.options.is_live_change(options):
            return False
        self.options = self.commissioning.options = options
        for name, servo in self.servos.items():
            servo.use_options(options.servos[name])
        return True

    def step(self, servo: str) -> float:
        return self.servos[servo].calibration.unit_per_step

    # Addressing

    def ping(self, node: int) -> Request[int | None]:
        """Return a read of the id (KST RS422, 3.4); its value is None, because a reply has no status byte."""
        return Read(self.settings, node, Command.READ_ID, _nothing)

    def unused(self) -> Request[Any]:
        first, last = self.options.id_range
        free = (node for node in range(last, first - 1, -1) if node not in self.by_node)
        return Read(self.settings, next(free, last), Command.READ_ID, _nothing, once=True)

    def fence(self, node: int, avoid: Sequence[Hashable], enabled: Collection[str]) -> Plan[bool]:
        """Send a fence, then read the position of an enabled servo: outside its travel range it has restarted.

        Each read has only one form. So the fences take turns, and a position read without a reply may be under way as well. A
        node that is silent may answer at its saved new id, so that is asked too.
        """
        attempt = partial(self._fence, node, enabled)
        try:
            position = (Command.READ_POSITION,)
            return (yield from fence.fence(attempt, FENCES, avoid, after_failure=position, retry_on=ReplyTimeout))
        except ReplyTimeout:
            yield from self.commissioning.ask_new_id(node)
            raise

    def _fence(self, node: int, enabled: Collection[str], command: Command) -> Plan[bool]:
        yield from ask(Fence(self.settings, node, command, self.commissioning.own_ids(node)))
        servo = self.by_node.get(node)
        if servo is None or not enabled:
            return True
        try:
            yield from locate(self.settings, servo, once=True)
        except DeviceError:
            return True  # it answers, and does not report its position
        return not servo.travel.jumped

    def inspect(self, node: int) -> Plan[Identity]:
        result = yield from identity.inspect(self.settings, node)
        self.commissioning.answered(node)
        return result

    def identify(self, servo: str) -> Plan[Identity]:
        return self._identify(self.servos[servo])

    def _identify(self, servo: CalibratedServo) -> Plan[Identity]:
        result = yield from identity.identify(self.settings, servo.node)
        notes = [*result.notes]
        if servo.node in self.commissioning.pending:
            notes.append(str(self.commissioning.pending[servo.node]))
        if self.options.sdo_order == "auto" and self.settings.aborts.learned == "le":
            notes.append("its abort codes come low byte first, not as the document prints them")
        return replace(result, mode="position", notes=tuple(notes))

    # Reading

    def read_state(self, servo: str) -> Request[dict[str, Update]]:
        """Return the read of the position, the only field that one request can bring."""
        return self._state_reads[servo, "feedback"]

    def polls(self, rates: Mapping[str, float]) -> Sequence[Poll]:
        """Return one read for each servo: the position for feedback, the status for health."""
        return single_polls(rates, self.nodes, lambda part, servo: self._state_reads[servo, part])

    def _state_read(self, name: str, part: str) -> Request[dict[str, Update]]:
        servo = self.servos[name]
        if part == "feedback":
            command, decode = Command.READ_POSITION, servo.decode_position
        else:
            command, decode = Command.READ_STATUS, servo.decode_status
        return Read(self.settings, servo.node, command, lambda data: {name: decode(data)})

    def read_register(self, servo: str, register: str, *, raw: bool = False) -> Request[Any]:
        key = (servo, register, raw)
        if key not in self._reads:
            target = self.servos[servo]
            command = Command(target.model.readable(register).address)
            makers = {
                Command.READ_ID: _first_byte,
                Command.READ_POSITION: target.read_steps if raw else target.read_position,
                Command.READ_STATUS: partial(_integer, 2),
                Command.READ_VERSION: partial(_integer, 4) if raw else version_text,
            }
            self._reads[key] = Read(self.settings, target.node, command, makers[command])
        return self._reads[key]

    # Writing

    def write_register(self, servo: str, register: str, value: Any, *, raw: bool = False, persist: bool = False) -> Plan[Any]:
        """Refuse: a KST servo has no memory table. Raises NotSupported, UnknownName."""
        name = self.servos[servo].model.writable(register).name
        raise NotSupported(f"{name} cannot be written as a register: {OTHER_VERBS[name]}", servo=servo)

    # Motion

    def enable(self, servo: str) -> Plan[float | None]:
        return goals.enable(self.settings, self.servos[servo])

    def disable(self, servo: str) -> Plan[StopReport]:
        return goals.disable(self.settings, self.servos[servo])

    def stop(self, targets: Sequence[StopTarget]) -> Plan[dict[str, StopReport]]:
        return goals.stop(self.settings, [(self.servos[target.servo], target) for target in targets])

    def verify(self, servos: Sequence[str]) -> Plan[Mapping[str, Loss]]:
        """Read where each servo is: the protocol shows a restart only by that."""
        for servo in servos:
            yield from goals.verify(self.settings, self.servos[servo])
        return {servo: loss for servo in servos if (loss := self.servos[servo].loss) is not None}

    def check_goal(self, goal: ServoGoal) -> None:
        if goal.servo not in self.servos:
            raise UnknownName(f"no servo {goal.servo} on this bus")
        servo = self.servos[goal.servo]
        if goal.goal.kind != "position":
            raise NotSupported("a KST servo has positions only: give it a position", servo=servo.name)
        for name, value in (("acceleration", goal.goal.acceleration), ("effort", goal.goal.effort)):
            if value is not None:
                raise NotSupported(f"{name}: a KST servo has no command for it: take it out", servo=servo.name)
        goals.refuse_faulty(self.settings, servo)
        servo.to_raw(goal.goal.value)
        self.host_speed(goal)

    def host_speed(self, goal: ServoGoal) -> float:
        """Return the speed (unit/s) that the host keeps on the way: left alone, a servo goes as fast as it can."""
        servo = self.servos[goal.servo]
        if goal.goal.speed == 0:
            raise LimitError(
                "speed 0 means no limit, and the host keeps the speed of a KST servo: give a speed", servo=servo.name
            )
        speed = goal_speed(goal, servo.options, servo.model_speed)
        if goal.start is None:
            raise LimitError(
                "its position is not known, so the host cannot keep its speed: read the servo first", servo=servo.name
            )
        return speed

    def plan_goals(self, goals_: Sequence[ServoGoal], *, together: bool, confirm: bool) -> Sequence[GoalPlan]:
        """Return one plan for each goal, or one for all. Each goal is confirmed by its reply, with or without `confirm`."""
        return goals.plan_setpoints(self.settings, self._setpoints(goals_), together=together)

    def _setpoints(self, goals_: Sequence[ServoGoal]) -> list[goals.Setpoint]:
        return [(self.servos[goal.servo], goal, self.servos[goal.servo].to_raw(goal.goal.value)) for goal in goals_]

    def preview_goals(self, goals_: Sequence[ServoGoal]) -> Sequence[Request[Any]]:
        """Return the frames of each goal; one of a ramp reads the servo first."""
        frames: list[Request[Any]] = []
        for servo, goal, raw in self._setpoints(goals_):
            frames += [] if goal.lead is None else [position_read(self.settings, servo)]
            frames.append(goals.set_position(self.settings, servo, raw))
        return frames

    def preview_stop(self, targets: Sequence[StopTarget]) -> Sequence[Request[Any]]:
        """Return the read of each servo and the position that it is sent."""
        servos = [self.servos[target.servo] for target in targets]
        makers: tuple[Callable[[CalibratedServo], Request[Any]], ...] = (
            partial(position_read, self.settings),
            lambda servo: goals.set_position(self.settings, servo, servo.range[0]),
        )
        return [make(servo) for servo in servos for make in makers]

    def fault_names(self, servo: str, status: int | None) -> tuple[str, ...]:
        """Return the status bits that the config names, and the faults that the host has found out."""
        target = self.servos[servo]
        bits = target.status if status is None else status
        names = {**target.model.status_bits, **self.options.status_bits}
        named = [name for bit, name in sorted(names.items()) if bits is not None and bits >> bit & 1]
        own = {
            "hardware fault": target.node in self.settings.aborts.faulty,
            "outside range": target.outside,
            "restarted": target.travel.jumped,
            "pending_reboot": target.node in self.commissioning.pending,
        }
        return (*named, *(name for name, is_set in own.items() if is_set))


def _nothing(data: bytes) -> int | None:
    return None


def _first_byte(data: bytes) -> int:
    return data[0]


def _integer(size: int, data: bytes) -> int:
    return int.from_bytes(data[:size], "little")
