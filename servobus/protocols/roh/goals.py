"""Goals of fingers: all goals of a hand in one plan, their targets in the fewest writes of consecutive registers.

Speed and current limit are written first, and only where the hand holds another value. A finger whose setting was refused gets no
target, because it would move with the wrong setting.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from servobus.errors import ServobusError
from servobus.protocols.base import GoalPlan, Plan, Request, ask
from servobus.protocols.roh.finger import Finger
from servobus.protocols.roh.hand import Hand, RegisterValue
from servobus.protocols.roh.spans import write_spans
from servobus.values import Outcome, ServoGoal

Results = dict[str, Outcome | Exception]
Failures = dict[Finger, ServobusError]


@dataclass(frozen=True, slots=True)
class HandGoals:
    """The goals of one hand."""

    hand: Hand
    goals: Sequence[tuple[Finger, ServoGoal]]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(finger.name for finger, _ in self.goals)

    def send(self) -> Plan[Results]:
        """Send the goals. Raises nothing: every finger ends in an outcome or an error of its own."""
        try:
            yield from self.hand.attach()
            failed = yield from self._send()
        except ServobusError as error:
            failed = {finger: error for finger, _ in self.goals}
        return {
            finger.name: failed[finger].at(servo=finger.name) if finger in failed else Outcome.ACKED for finger, _ in self.goals
        }

    def _send(self) -> Plan[Failures]:
        model = self.hand.map
        targets: list[RegisterValue] = []
        settings: list[RegisterValue] = []
        failed: Failures = {}
        for finger, goal in self.goals:
            try:
                changes = finger.changed_settings(model, goal)
                targets.append(RegisterValue(finger, finger.target_name, finger.target(model, goal)))
            except ServobusError as error:
                failed[finger] = error
            else:
                settings += [RegisterValue(finger, name, raw) for name, raw in changes.items()]
        failed |= yield from write_values(self.hand, settings)
        failed |= yield from write_values(self.hand, [value for value in targets if value.finger not in failed])
        return failed


def plan_hands(parts: Sequence[HandGoals], *, together: bool) -> list[GoalPlan]:
    """Return one plan for each hand, or one for all."""
    if together and len(parts) > 1:
        return [GoalPlan(tuple(name for part in parts for name in part.names), _send_all(parts), len(parts))]
    return [GoalPlan(part.names, part.send()) for part in parts]


def _send_all(parts: Sequence[HandGoals]) -> Plan[Results]:
    results: Results = {}
    for part in parts:
        results |= yield from part.send()
    return results


def write_values(hand: Hand, values: Sequence[RegisterValue]) -> Plan[Failures]:
    """Write registers in the fewest writes, and return which failed. A refused write does not stop the others."""
    model = hand.map
    by_address = {value.finger.address(model, value.name): value for value in values}
    failed: Failures = {}
    for span in write_spans(by_address, hand.limits.write):
        group = [by_address[address] for address in range(span.start, span.end)]
        for value in group:
            value.finger.held.before_write(value.name, value.raw)
        try:
            yield from hand.explained(ask(hand.write(span.start, [model.named(v.name).to_word(v.raw) for v in group])))
        except ServobusError as error:
            failed |= {value.finger: error for value in group}
        else:
            for value in group:
                value.finger.held.confirm(value.name, value.raw)
    return failed


def target_writes(hand: Hand, fingers: Sequence[Finger]) -> list[Request[None]]:
    """Return requests of the size that the targets of these fingers take, for previews."""
    addresses = [finger.address(hand.map, finger.target_name) for finger in fingers]
    return [hand.write(span.start, [0] * span.count) for span in write_spans(addresses, hand.limits.write)]


def by_hand(hands: Mapping[int, Hand], goals: Sequence[tuple[Finger, ServoGoal]]) -> list[HandGoals]:
    """Return the goals of each hand, in the order of their first goals."""
    parts: dict[int, list[tuple[Finger, ServoGoal]]] = {}
    for finger, goal in goals:
        parts.setdefault(finger.node, []).append((finger, goal))
    return [HandGoals(hands[unit], part) for unit, part in parts.items()]
