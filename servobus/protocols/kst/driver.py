"""The KST driver: what to say for each verb (seed, section 3). Sans-IO. Written from the specification, never seen on hardware.

The protocol has no ping, torque, stop or speed command. So: ping reads the id; enabled is the host's gate, and writes nothing; a
stop sends the last setpoint once more; and the host must keep speeds itself (`pace`).
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from servobus.errors import DeviceError, LimitError, NotSupported, ReplyTimeout, UnknownName
from servobus.protocols.base import Driver, GoalPlan, Plan, Poll, Request, ask
from servobus.protocols.kst import goals, identity
from servobus.protocols.kst.codec import Command, decode_position, version_text
from servobus.protocols.kst.commissioning import Commissioning
from servobus.protocols.kst.model import KstModel
from servobus.protocols.kst.options import KstBus
from servobus.protocols.kst.requests import Fence, FrameTiming, Read
from servobus.protocols.kst.servo import FittedServo
from servobus.values import Identity, ServoGoal, StopReport, StopTarget, Update

FENCES = (Command.READ_ID, Command.READ_VERSION, Command.READ_STATUS, Command.READ_POSITION)
"""The reads there are; a fence is one whose reply is not under way. The first names the servo in its data too."""
FENCE_TRIES = 2
VERBS = {"goal_position": "use move", "id": "use commissioning (set_id)", "baud_rate": "use commissioning (set_baudrate)"}
"""Registers that another verb writes."""


class KstDriver(Driver):
    """See `protocols.base.Driver`."""

    commissioning: Commissioning

    def __init__(self, options: KstBus, models: Mapping[str, KstModel]) -> None:
        self.options = options
        self.servos = {name: FittedServo(name, servo, models[servo.model]) for name, servo in options.servos.items()}
        self.by_node = {servo.node: servo for servo in self.servos.values()}
        self.nodes = {name: servo.node for name, servo in self.servos.items()}
        self.timing = FrameTiming.of(options)
        self.commissioning = Commissioning(options, self.timing)
        # Requests are immutable, and the same few are said again and again.
        self._state_reads = {
            (name, part): self._state_read(name, part) for name in self.servos for part in ("feedback", "health")
        }
        self._reads: dict[tuple[str, str, bool], Request[Any]] = {}

    def step(self, servo: str) -> float:
        return self.servos[servo].calibration.unit_per_step

    # Who is there

    def ping(self, node: int) -> Request[int | None]:
        """Read id (3.4). There is no status byte."""
        return Read(self.timing, node, Command.READ_ID, _nothing)

    def unused(self) -> Request[Any]:
        first, last = self.options.id_range
        free = (node for node in range(last, first - 1, -1) if node not in self.by_node)
        return Read(self.timing, next(free, last), Command.READ_ID, _nothing, once=True)

    def fence(self, node: int, avoid: Sequence[Hashable], enabled: Collection[str]) -> Plan[bool]:
        """There is one form of each read only, so fences take turns: the answer to a fence that was given up must not be taken
        for the next one's. An enabled servo that stands where nobody sent it has restarted."""
        used = list(avoid)
        for _ in range(FENCE_TRIES - 1):
            command = fence_command(used)
            try:
                return (yield from self._recover(node, command, enabled))
            except ReplyTimeout:
                used += (command, Command.READ_POSITION)
        return (yield from self._recover(node, fence_command(used), enabled))

    def _recover(self, node: int, command: Command, enabled: Collection[str]) -> Plan[bool]:
        yield from ask(Fence(self.timing, node, command, self.commissioning.own_ids(node)))
        servo = self.by_node.get(node)
        if servo is None or not enabled:
            return True
        try:
            # Once: behind the fence, nothing would tell the answer to a second question from that to the first.
            servo.seen((yield from ask(Read(self.timing, node, Command.READ_POSITION, decode_position, once=True))))
        except DeviceError:
            return True  # it refuses to say
        return not servo.jumped

    def inspect(self, node: int) -> Plan[Identity]:
        return identity.inspect(self.timing, node)

    def identify(self, servo: str) -> Plan[Identity]:
        return self._identify(self.servos[servo])

    def _identify(self, servo: FittedServo) -> Plan[Identity]:
        seen = yield from identity.identify(self.timing, servo.node)
        notes = [*seen.notes]
        if servo.node in self.commissioning.pending:
            notes.append(str(self.commissioning.pending[servo.node]))
        if self.options.sdo_order == "auto" and self.timing.aborts.learned == "le":
            notes.append("its abort codes come low byte first, not as the specification prints them")
        return replace(seen, mode="position", notes=tuple(notes))

    # Reading

    def read_state(self, servo: str) -> Request[dict[str, Update]]:
        """The position: it is the only thing one question can bring."""
        return self._state_reads[servo, "feedback"]

    def polls(self, rates: Mapping[str, float]) -> Sequence[Poll]:
        """One read per servo: position for feedback, status for health."""
        return [
            Poll(part, hz, (node,), partial(self._poll_request, servo, part))
            for part, hz in rates.items()
            for servo, node in self.nodes.items()
        ]

    def _poll_request(self, servo: str, part: str, reachable: Collection[int]) -> Request[dict[str, Update]] | None:
        return self._state_reads[servo, part] if self.nodes[servo] in reachable else None

    def _state_read(self, servo: str, part: str) -> Request[dict[str, Update]]:
        fitted = self.servos[servo]
        if part == "feedback":
            command, decode = Command.READ_POSITION, fitted.decode_position
        else:
            command, decode = Command.READ_STATUS, fitted.decode_status
        return Read(self.timing, fitted.node, command, lambda data: {servo: decode(data)})

    def read_register(self, servo: str, register: str, *, raw: bool = False) -> Request[Any]:
        known = self._reads.get((servo, register, raw))
        if known is not None:
            return known
        fitted = self.servos[servo]
        command = Command(fitted.model.readable(register).address)
        makers = {
            Command.READ_ID: _first,
            Command.READ_POSITION: fitted.position_of if raw else fitted.position,
            Command.READ_STATUS: _word,
            Command.READ_VERSION: _double_word if raw else version_text,
        }
        request = self._reads[servo, register, raw] = Read(self.timing, fitted.node, command, makers[command])
        return request

    # Writing

    def write_register(self, servo: str, register: str, value: Any, *, raw: bool = False, persist: bool = False) -> Plan[Any]:
        """Nothing can be written by name: there is no memory table. Raises NotSupported, UnknownName."""
        found = self.servos[servo].model.writable(register)
        raise NotSupported(f"{found.name} is not written by hand: {VERBS[found.name]}", servo=servo)

    # Motion

    def enable(self, servo: str) -> Plan[float | None]:
        """Opens the host's gate: reads the position and writes nothing, for there is no torque command, and a reading that is
        not the goal would move the servo if it were written."""
        fitted = self.servos[servo]
        raw = yield from ask(Read(self.timing, fitted.node, Command.READ_POSITION, fitted.position_of))
        self.timing.aborts.faulty.discard(fitted.node)
        fitted.enabled(raw)
        return fitted.to_unit(raw)

    def disable(self, servo: str) -> Plan[StopReport]:
        return goals.disable(self.servos[servo])

    def stop(self, targets: Sequence[StopTarget]) -> Plan[dict[str, StopReport]]:
        return goals.stop(self.timing, [(self.servos[target.servo], target) for target in targets])

    def check_goal(self, goal: ServoGoal) -> None:
        if goal.servo not in self.servos:
            raise UnknownName(f"no servo {goal.servo} on this bus")
        servo, wanted = self.servos[goal.servo], goal.goal
        if wanted.kind != "position":
            raise NotSupported("a KST servo does positions only: give it a position", servo=servo.name)
        for what, value in (("acceleration", wanted.acceleration), ("effort", wanted.effort)):
            if value is not None:
                raise NotSupported(f"{what}: a KST servo has no command for it: take it out", servo=servo.name)
        if wanted.speed == 0 and not servo.options.allow_max_speed:
            raise LimitError("speed 0 means no limit: give a speed, or set allow_max_speed", servo=servo.name)
        goals.refuse_faulty(self.timing, servo)
        servo.to_raw(wanted.value)
        self.host_speed(goal)

    def host_speed(self, goal: ServoGoal) -> float | None:
        """The goal's own speed, else the servo's, else its greatest, else the model's: left alone it goes as fast as it can."""
        servo, wanted = self.servos[goal.servo], goal.goal
        if wanted.speed == 0:
            return None
        if goal.start is None:
            raise LimitError("its position is not known, so it cannot be led anywhere: read the servo first", servo=servo.name)
        if wanted.duration is None:
            return wanted.speed or servo.default_speed
        return abs(wanted.value - goal.start) / wanted.duration or None

    def plan_goals(self, goals_: Sequence[ServoGoal], *, together: bool, confirm: bool) -> Sequence[GoalPlan]:
        """Each goal is confirmed by its echo, asked for or not."""
        steps = [(self.servos[goal.servo], self.servos[goal.servo].to_raw(goal.goal.value)) for goal in goals_]
        return goals.turns(self.timing, steps, together=together)

    def fault_names(self, servo: str, status: int | None) -> tuple[str, ...]:
        """Bits of the status bytes that the config names, and what the host has found out itself."""
        fitted = self.servos[servo]
        bits = fitted.status if status is None else status
        names = {**fitted.model.status_bits, **self.options.status_bits}
        found = [name for bit, name in sorted(names.items()) if bits is not None and bits >> bit & 1]
        own = {
            "hardware fault": fitted.node in self.timing.aborts.faulty,
            "outside range": fitted.outside,
            "restarted": fitted.jumped,
            "pending_reboot": fitted.node in self.commissioning.pending,
        }
        return (*found, *(name for name, holds in own.items() if holds))


def fence_command(avoid: Sequence[Hashable]) -> Command:
    """A read that no reply under way can belong to; when all are taken, the one asked longest ago (`avoid` is oldest first)."""
    free = (command for command in FENCES if command not in avoid)
    return next(free, None) or next(Command(key) for key in avoid if key in FENCES)


def _nothing(data: bytes) -> int | None:
    return None


def _first(data: bytes) -> int:
    return data[0]


def _word(data: bytes) -> int:
    return int.from_bytes(data[:2], "little")


def _double_word(data: bytes) -> int:
    return int.from_bytes(data[:4], "little")
