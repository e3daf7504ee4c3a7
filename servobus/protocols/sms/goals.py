"""How goals reach FEETECH servos: one WRITE, one SYNC WRITE, or one REG WRITE each and one ACTION.

A REG WRITE waits in its servo until ACTION (SMS 1.0, 1.3.4 and 1.3.5). `armed` keeps who may hold one, and ACTION to all is
withheld while anybody else does. A plan may be closed at any frame: a servo enters that table before its REG WRITE leaves.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from servobus.errors import ActionWithheld, NotSupported, ReplyTimeout, ServobusError, UnknownName
from servobus.protocols.base import GoalPlan, Plan, Request, ask
from servobus.protocols.sms.armed import Armed, read_flag
from servobus.protocols.sms.options import SmsBus
from servobus.protocols.sms.packer import GoalPacker, PackedGoal
from servobus.protocols.sms.requests import Action, RegWrite, SyncWrite, Write, sync_write_size
from servobus.protocols.sms.servo import HostServo
from servobus.values import Outcome, ServoGoal

MAX_FRAME_SECONDS = 0.010
"""No frame holds the line longer than this, so that an e-stop never waits longer."""

Results = dict[str, Outcome | Exception]


class GoalWriter:
    """Packs goals and plans their turns."""

    def __init__(self, options: SmsBus, servos: Mapping[str, HostServo], armed: Armed) -> None:
        self.options = options
        self.packers = {name: GoalPacker(servo) for name, servo in servos.items()}
        self._armed = armed

    def check(self, goal: ServoGoal) -> PackedGoal:
        """Return the packed goal. A duration whose start is not known yet is packed as if the servo were there already."""
        packer = self.packers.get(goal.servo)
        if packer is None:
            raise UnknownName(f"no servo {goal.servo} on this bus")
        if goal.start is None:
            goal = ServoGoal(goal.servo, goal.goal, goal.goal.value)
        return packer.pack(goal)

    def plan(self, goals: Sequence[ServoGoal], *, together: bool, confirm: bool) -> list[GoalPlan]:
        """Return the fewest plans that carry these goals."""
        parts = [self._packed(goal) for goal in goals]
        if len(parts) == 1 and (not confirm or parts[0].servo.answers_writes):
            return [GoalPlan((parts[0].servo.name,), self._write_frame(parts))]
        spans = {(part.address, len(part.data)) for part in parts}
        frames = list(self._split(parts))
        if confirm or len(spans) > 1 or (together and len(frames) > 1):
            _require_flags(parts)
            return [GoalPlan(_names(parts), self._reg_write_action(parts), len(parts) + 1)]
        return [GoalPlan(_names(frame), self._write_frame(frame)) for frame in frames]

    def preview(self, goals: Sequence[ServoGoal]) -> list[Request[Any]]:
        """Return the frames of these goals once the servos hold their settings."""
        parts = [self.packers[goal.servo].pack(goal, {}) for goal in goals]
        if len({(part.address, len(part.data)) for part in parts}) > 1:
            return [*(self._reg_write(part) for part in parts), Action()]
        return [self._frame(frame) for frame in self._split(parts)]

    def _packed(self, goal: ServoGoal) -> PackedGoal:
        packed = goal.packed
        return packed if packed is not None and packed.is_for(goal) else self.packers[goal.servo].pack(goal)

    def _split(self, parts: Sequence[PackedGoal]) -> Iterator[Sequence[PackedGoal]]:
        """Parts of one SYNC WRITE each."""
        if parts:
            count = max_servos(self.options, len(parts[0].data))
            for start in range(0, len(parts), count):
                yield parts[start : start + count]

    # WRITE and SYNC WRITE

    def _frame(self, parts: Sequence[PackedGoal]) -> Write | SyncWrite:
        part = parts[0]
        if len(parts) == 1:
            return Write(part.servo.node, part.address, part.data, answered=part.servo.answers_writes)
        return SyncWrite(part.address, {part.servo.node: part.data for part in parts})

    def _write_frame(self, parts: Sequence[PackedGoal]) -> Plan[Results]:
        for part in parts:
            if part.settings:
                part.servo.forget(part.settings)
        if self._armed.sent:
            yield from self._armed.disarm_sent({part.servo.node for part in parts})
        request = self._frame(parts)
        yield request
        for part in parts:
            if part.settings:
                part.servo.sent(part.settings, acknowledged=request.replies > 0)
        return dict.fromkeys(_names(parts), Outcome.ACKED if request.replies else Outcome.SENT)

    # REG WRITE and ACTION

    def _reg_write_action(self, parts: Sequence[PackedGoal]) -> Plan[Results]:
        results: Results = {}
        for part in parts:
            self._armed.arming(part.servo.node)
            part.servo.forget(part.settings)
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
                yield from self._armed.disarm(part.servo)
            return results
        if self._armed.all_answered({part.servo.node for part in parts}):
            yield from ask(Action())
            for part in parts:
                self._armed.fired(part.servo.node)
        else:
            results |= yield from self._fire_each(armed)
        for part in armed:
            part.servo.hold(part.settings)
        return results

    def _fire_each(self, parts: Sequence[PackedGoal]) -> Plan[Results]:
        """Send each servo an ACTION of its own, at once after one another. It is never repeated: the first may have worked."""
        failed: Results = {}
        for part in parts:
            servo = part.servo
            self._armed.fired(servo.node)
            try:
                yield from ask(Action(servo.node, answered=servo.answers_writes))
            except ServobusError as error:
                failed[servo.name] = error
        return failed

    def _reg_write(self, part: PackedGoal) -> RegWrite:
        return RegWrite(part.servo.node, part.address, part.data, answered=part.servo.answers_writes)

    def _arm(self, part: PackedGoal) -> Plan[None]:
        yield from ask(self._reg_write(part))
        if not part.servo.answers_writes and not (yield from ask(read_flag(part.servo.node))):
            raise ReplyTimeout("the servo did not take the REG WRITE: its flag reads 0", servo=part.servo.name)

    def _obstacle(self, parts: Sequence[PackedGoal], armed: Sequence[PackedGoal]) -> Plan[str]:
        """Return why ACTION must not be sent now; empty: it may."""
        if not armed:
            return "no servo acknowledged its REG WRITE"
        silent = [part.servo.name for part in parts if part not in armed]
        if silent and self.options.on_partial == "abort":
            return f"{', '.join(silent)} did not acknowledge its REG WRITE (on_partial: abort)"
        return (yield from self._armed.obstacle({part.servo.node for part in parts}))


def max_frame_size(options: SmsBus) -> int:
    """Return the bytes of the longest SYNC WRITE: what the servos' buffers can take, and at most 10 ms of wire time."""
    return min(options.sync_max_bytes, int(MAX_FRAME_SECONDS * options.baudrate / 10))


def max_servos(options: SmsBus, size: int) -> int:
    """Return how many servos one SYNC WRITE carries, with `size` bytes each: at least 1."""
    return max(1, (max_frame_size(options) - sync_write_size(0, 0)) // (size + 1))


def _names(parts: Sequence[PackedGoal]) -> tuple[str, ...]:
    return tuple([part.servo.name for part in parts])


def _require_flags(parts: Sequence[PackedGoal]) -> None:
    for part in parts:
        if not part.servo.answers_writes and "async_write_flag" not in part.servo.model.registers:
            raise NotSupported(
                "the servo answers no write and its REG WRITE flag cannot be read, so nothing can be confirmed: "
                "set its response level to 1 and status_return to all",
                servo=part.servo.name,
            )
