"""How fingers come to rest: target := present. There is no torque command, so a hand can be told no more, and keeps holding.

First every target whose place is known well enough, then the places are asked for and written once more, acknowledged; hands that
do not answer are told twice, last, because nobody waits for them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from servobus.errors import LimitError, ServobusError
from servobus.protocols.base import Plan, ask
from servobus.protocols.modbus.requests import UnansweredWrite
from servobus.protocols.roh.finger import Finger
from servobus.protocols.roh.goals import Word, write_words
from servobus.protocols.roh.hand import Hand
from servobus.protocols.roh.model import RohModel
from servobus.protocols.roh.spans import write_spans
from servobus.values import StopReport, StopTarget

TIMES = 2
"""What is not answered is said twice, because a lossy line may swallow one."""
HOLDS = "a ROH hand has no torque command: the finger keeps holding"
NOT_OURS = "it was not enabled: nothing of ours moves it"

Targets = Sequence[tuple[Finger, StopTarget]]


def stop(hands: Mapping[int, Hand], targets: Targets) -> Plan[dict[str, StopReport]]:
    reports = {finger.name: StopReport("none", False, True, NOT_OURS) for finger, target in targets if not target.enabled}
    enabled = [(finger, target) for finger, target in targets if target.enabled]
    present = {unit: [entry for entry in enabled if entry[0].node == unit and entry[1].reachable] for unit in hands}
    absent = {unit: [entry for entry in enabled if entry[0].node == unit and not entry[1].reachable] for unit in hands}
    written: set[Finger] = set()
    for unit, some in present.items():
        words = _known(hands[unit], some)
        failed = yield from write_words(hands[unit], words)
        written |= {word.finger for word in words} - set(failed)
    for unit, some in present.items():
        reports |= yield from _hold(hands[unit], some, written)
    for unit, some in absent.items():
        reports |= yield from _tell(hands[unit], some)
    for finger, target in targets:
        finger.enabled = finger.enabled and target.kind != "limp"
    return {finger.name: reports[finger.name] for finger, _ in targets}


def disable(finger: Finger) -> Plan[StopReport]:
    """The host's gate closes, and nothing is said."""
    yield from ()
    finger.enabled = False
    return StopReport("hold", False, True, HOLDS)


def _known(hand: Hand, targets: Targets) -> list[Word]:
    """What can be written without a question."""
    words = []
    for finger, target in targets:
        raw = None if target.position is None or hand.obstacle else _place(finger, hand.map, target.position)
        if raw is not None:
            words.append(Word(finger, finger.target_name, raw))
    return words


def _place(finger: Finger, model: RohModel, position: float) -> int | None:
    try:
        return finger.target_at(model, position)
    except LimitError:
        return None  # between two limits that differ a little: the question settles it


def _hold(hand: Hand, targets: Targets, written: set[Finger]) -> Plan[dict[str, StopReport]]:
    """Ask where they are, and write that."""
    failed: dict[Finger, ServobusError] = {}
    try:
        yield from hand.attach()
        here = yield from hand.explained(hand.words({finger: (finger.place_name,) for finger, _ in targets}))
        words = [Word(finger, finger.target_name, raw) for finger, _, raw in here]
        failed = yield from write_words(hand, words)
    except ServobusError as error:
        failed = {finger: error for finger, _ in targets}
    return {finger.name: _report(finger, target, failed.get(finger), written) for finger, target in targets}


def _report(finger: Finger, target: StopTarget, error: ServobusError | None, written: set[Finger]) -> StopReport:
    if error is not None:
        return StopReport("hold", finger in written, False, error.message)
    return StopReport("hold", True, True, HOLDS if target.kind == "limp" else "")


def _tell(hand: Hand, targets: Targets) -> Plan[dict[str, StopReport]]:
    """Targets for a hand that does not answer: where each finger was last seen, if that is known."""
    model = hand.map
    words = {finger.address(model, finger.target_name): finger for finger, _ in targets}
    raws = {word.finger: word.raw for word in _known(hand, targets)}
    known = [address for address, finger in words.items() if finger in raws]
    for span in write_spans(known, hand.limits.write):
        run = [words[address] for address in range(span.start, span.end)]
        values = [model.named(finger.target_name).word(raws[finger]) for finger in run]
        for finger in run:
            finger.may_hold(raws[finger])
        for _ in range(TIMES):
            yield from ask(UnansweredWrite(hand.timing, hand.unit, span.start, values))
    return {
        finger.name: StopReport(
            "hold",
            finger in raws,
            False,
            "offline: nothing was confirmed" if finger in raws else "offline, and where it is is not known: nothing was written",
        )
        for finger, _ in targets
    }
