"""How goals reach FEETECH servos (DESIGN section 3): one WRITE, one SYNC WRITE, or REG WRITE each and one ACTION.

REG WRITE needs care (seed 1.3.4, 1.3.5): a servo whose acknowledgement is missing may be armed all the same, and a later ACTION
would move it. Such nodes stand in `maybe_armed` until they are overwritten or their flag was read.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from servobus.errors import ActionWithheld, NotSupported, ReplyTimeout, ServobusError
from servobus.protocols.base import GoalPlan, Plan, ask
from servobus.protocols.sms.codec import OVERHEAD
from servobus.protocols.sms.options import SmsBus
from servobus.protocols.sms.requests import Action, Read, RegWrite, SyncWrite, Write, sync_write_size
from servobus.protocols.sms.servo import FittedServo
from servobus.values import Outcome, ServoGoal

MAX_FRAME_SECONDS = 0.010
"""No frame holds the line longer than this, so that an e-stop never waits longer."""

Results = dict[str, Outcome | Exception]


@dataclass(frozen=True, slots=True)
class Part:
    """One servo's share of a goal frame."""

    servo: FittedServo
    address: int
    data: bytes
    extras: dict[str, int]

    def sent(self) -> None:
        self.servo.extras.update(self.extras)


@dataclass(slots=True)
class GoalWriter:
    """Plans the turns of goals. Remembers between turns which nodes may hold a REG WRITE nobody acknowledged."""

    options: SmsBus
    maybe_armed: dict[int, FittedServo] = field(default_factory=dict)

    def plan(self, goals: Sequence[tuple[FittedServo, ServoGoal]], *, together: bool, confirm: bool) -> list[GoalPlan]:
        parts = [Part(servo, *servo.goal_span(goal), servo.changed_extras(goal)) for servo, goal in goals]
        if len(parts) == 1 and (self.acknowledged or not confirm):
            return [self._turn(parts, self._write(parts[0]))]
        spans = {(part.address, len(part.data)) for part in parts}
        frames = list(self._split(parts))
        if confirm or len(spans) > 1 or (together and len(frames) > 1):
            if not self.acknowledged:
                self._require_flags(parts)
            return [self._turn(parts, self._reg_write_action(parts), len(parts) + 1)]
        return [self._turn(frame, self._write(frame[0]) if len(frame) == 1 else self._sync_write(frame)) for frame in frames]

    @property
    def acknowledged(self) -> bool:
        """Whether servos answer writes (response level of the memory table)."""
        return self.options.status_return == "all"

    def frame_size(self) -> int:
        """Greatest SYNC WRITE frame: what the servos' buffers are trusted with, and no more than 10 ms of wire."""
        return min(self.options.sync_max_bytes, int(MAX_FRAME_SECONDS * self.options.baudrate / 10))

    def _split(self, parts: Sequence[Part]) -> Iterator[list[Part]]:
        each = len(parts[0].data) + 1
        count = max(1, (self.frame_size() - sync_write_size(0, 0)) // each)
        for start in range(0, len(parts), count):
            yield list(parts[start : start + count])

    @staticmethod
    def _turn(parts: Sequence[Part], plan: Plan[Results], frames: int = 1) -> GoalPlan:
        return GoalPlan(tuple(part.servo.name for part in parts), plan, frames)

    def _write(self, part: Part) -> Plan[Results]:
        yield from ask(Write(part.servo.node, part.address, part.data, answered=self.acknowledged))
        part.sent()
        return {part.servo.name: Outcome.ACKED if self.acknowledged else Outcome.SENT}

    def _sync_write(self, parts: Sequence[Part]) -> Plan[Results]:
        yield from ask(SyncWrite(parts[0].address, {part.servo.node: part.data for part in parts}))
        for part in parts:
            part.sent()
        return {part.servo.name: Outcome.SENT for part in parts}

    # REG WRITE and ACTION

    def _require_flags(self, parts: Sequence[Part]) -> None:
        for part in parts:
            if "async_write_flag" not in part.servo.model.registers:
                raise NotSupported(
                    "the servo answers no write and its REG WRITE flag cannot be read, so nothing can be confirmed: "
                    "set its response level to 1 and status_return to all",
                    servo=part.servo.name,
                )

    def _reg_write_action(self, parts: Sequence[Part]) -> Plan[Results]:
        self.maybe_armed |= {
            part.servo.node: part.servo for part in parts
        }  # until each is known not to be: a plan may be cut off at any frame
        results: Results = {}
        for part in parts:
            try:
                yield from self._arm(part)
                results[part.servo.name] = Outcome.ACKED
            except ServobusError as error:
                results[part.servo.name] = error
        armed = [part for part in parts if results[part.servo.name] is Outcome.ACKED]
        reason = yield from self._obstacle(parts, armed)
        if reason:
            for part in armed:
                results[part.servo.name] = ActionWithheld(f"not moved: {reason}", servo=part.servo.name)
                yield from self._disarm(part.servo)
            return results
        yield from ask(Action())
        for part in armed:
            part.sent()
            self.maybe_armed.pop(part.servo.node, None)
        return results

    def _arm(self, part: Part) -> Plan[None]:
        yield from ask(RegWrite(part.servo.node, part.address, part.data, answered=self.acknowledged))
        if not self.acknowledged and not (yield from self._flag(part.servo)):
            raise ReplyTimeout("the servo did not take the REG WRITE: its flag reads 0", servo=part.servo.name)

    def _obstacle(self, parts: Sequence[Part], armed: Sequence[Part]) -> Plan[str]:
        """Why ACTION must not be sent now; empty: it may."""
        if not armed:
            return "no servo acknowledged its REG WRITE"
        silent = [part.servo.name for part in parts if part not in armed]
        if silent and self.options.on_partial == "abort":
            return f"{', '.join(silent)} did not acknowledge its REG WRITE (on_partial: abort)"
        reason = ""
        for node in sorted(self.maybe_armed.keys() - {part.servo.node for part in parts}):
            reason = reason or (yield from self._suspicion(self.maybe_armed[node]))
        return reason

    def _suspicion(self, servo: FittedServo) -> Plan[str]:
        """What is left of it after the servo was asked, and disarmed if need be; empty: nothing."""
        try:
            pending = yield from self._flag(servo)
        except ServobusError:
            pending = 1
        if pending:
            yield from self._disarm(servo)
        else:
            self.maybe_armed.pop(servo.node, None)
        held = f"{servo.name} may hold an older REG WRITE that ACTION would carry out, and does not answer"
        return held if servo.node in self.maybe_armed else ""

    def _flag(self, servo: FittedServo) -> Plan[int]:
        register = servo.model.register("async_write_flag")
        return (yield from ask(Read(servo.node, register.address, register.size, _first)))

    def _disarm(self, servo: FittedServo) -> Plan[None]:
        """Overwrite what waits with something that moves nothing (the sentinel's own value), and let that be carried out."""
        register = servo.model.registers[servo.model.sentinel.name]
        harmless = servo.encode(register, servo.extras.get(register.name, servo.model.sentinel.value))
        try:
            yield from ask(RegWrite(servo.node, register.address, harmless, answered=self.acknowledged))
            yield from ask(Action(servo.node, answered=self.acknowledged))
        except ServobusError:
            return  # it stays in maybe_armed, and holds back the next ACTION
        self.maybe_armed.pop(servo.node, None)


def split_sync_write(options: SmsBus, address: int, data: dict[int, bytes]) -> Iterator[SyncWrite]:
    """SYNC WRITE frames of at most the bus's frame size for any number of servos."""
    size = len(next(iter(data.values()))) + 1
    count = max(1, (GoalWriter(options).frame_size() - OVERHEAD - 2) // size)
    nodes = list(data)
    for start in range(0, len(nodes), count):
        yield SyncWrite(address, {node: data[node] for node in nodes[start : start + count]})


def _first(data: bytes) -> int:
    return data[0]
