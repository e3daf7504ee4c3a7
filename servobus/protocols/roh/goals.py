"""How goals reach fingers: all goals of a hand in one plan, their targets in the fewest writes of contiguous registers.

What shapes the way (speed, current limit) is written before, and only where the hand holds another value; a finger whose setting
was refused is not sent off with the wrong one.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from servobus.errors import ServobusError
from servobus.protocols.base import GoalPlan, Plan, ask
from servobus.protocols.roh.finger import Finger
from servobus.protocols.roh.hand import Hand
from servobus.protocols.roh.spans import write_spans
from servobus.values import Outcome, ServoGoal

Results = dict[str, Outcome | Exception]
Failures = dict[Finger, ServobusError]


@dataclass(frozen=True, slots=True)
class Word:
    """One register of one finger, and what shall stand there."""

    finger: Finger
    name: str
    raw: int


@dataclass(frozen=True, slots=True)
class HandGoals:
    """The goals of one hand."""

    hand: Hand
    goals: Sequence[tuple[Finger, ServoGoal]]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(finger.name for finger, _ in self.goals)

    def send(self) -> Plan[Results]:
        """Raises nothing: every finger ends in an outcome or an error."""
        try:
            yield from self.hand.attach()
            failed = yield from self._send()
        except ServobusError as error:
            failed = {finger: error for finger, _ in self.goals}
        return {name: _own(failed[finger], name) if finger in failed else Outcome.ACKED for name, finger in self._fingers()}

    def _send(self) -> Plan[Failures]:
        model = self.hand.map
        targets: list[Word] = []
        settings: list[Word] = []
        failed: Failures = {}
        for finger, goal in self.goals:
            try:
                changes = finger.changes(model, goal)
                targets.append(Word(finger, finger.target_name, finger.target(model, goal)))
            except ServobusError as error:
                failed[finger] = error
            else:
                settings += [Word(finger, name, raw) for name, raw in changes.items()]
        failed |= yield from write_words(self.hand, settings)
        failed |= yield from write_words(self.hand, [word for word in targets if word.finger not in failed])
        return failed

    def _fingers(self) -> Iterable[tuple[str, Finger]]:
        return ((finger.name, finger) for finger, _ in self.goals)


def turns(parts: Sequence[HandGoals], *, together: bool) -> list[GoalPlan]:
    """One turn for each hand, or one for all."""
    if together and len(parts) > 1:
        return [GoalPlan(tuple(name for part in parts for name in part.names), _one_after_the_other(parts), len(parts))]
    return [GoalPlan(part.names, part.send()) for part in parts]


def _one_after_the_other(parts: Sequence[HandGoals]) -> Plan[Results]:
    results: Results = {}
    for part in parts:
        results |= yield from part.send()
    return results


def write_words(hand: Hand, words: Sequence[Word]) -> Plan[Failures]:
    """In the fewest writes. What one write is refused does not keep the others."""
    model = hand.map
    at = {word.finger.address(model, word.name): word for word in words}
    failed: Failures = {}
    for span in write_spans(at, hand.limits.write):
        run = [at[address] for address in range(span.start, span.end)]
        _forget(run)
        values = [model.named(word.name).word(word.raw) for word in run]
        try:
            yield from hand.explained(ask(hand.write(span.start, values)))
        except ServobusError as error:
            failed |= {word.finger: error for word in run}
        else:
            for word in run:
                word.finger.learn(word.name, word.raw)
    return failed


def _forget(run: Iterable[Word]) -> None:
    """Before a write: a plan may be cut off at any frame, and a write that failed may be applied, wholly or in part."""
    for word in run:
        if word.name == word.finger.target_name:
            word.finger.may_hold(word.raw)
        else:
            word.finger.settings.pop(word.name, None)


def _own(error: ServobusError, name: str) -> ServobusError:
    """One error may end several goals, each with its own name."""
    return error.at(servo=name)


def by_hand(hands: Mapping[int, Hand], goals: Sequence[tuple[Finger, ServoGoal]]) -> list[HandGoals]:
    """In the order of the hands' first goals."""
    parts: dict[int, list[tuple[Finger, ServoGoal]]] = {}
    for finger, goal in goals:
        parts.setdefault(finger.node, []).append((finger, goal))
    return [HandGoals(hands[unit], part) for unit, part in parts.items()]
