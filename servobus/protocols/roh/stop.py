"""Stops of fingers: target := present position. A hand has no torque command, so its fingers keep holding.

A stop has four steps:

1. Read where the fingers of the hands that answer are, and write that as their targets.
2. Read the targets back, and the positions twice with a pause between. Only a finger that holds its target and rests is
   confirmed: the reply to a write tells nothing of what the finger does.
3. A hand that does not answer is written to twice, without waiting for a reply, where a finger was on its way when it was read
   last and its place can be estimated. This comes after 1, so it delays nobody.
4. Nothing else is written to a hand that does not answer: if it has restarted, a position would move it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from servobus.errors import LimitError, ReplyTimeout, ServobusError
from servobus.protocols.base import Plan, ask
from servobus.protocols.modbus.requests import UnansweredWrite
from servobus.protocols.roh.finger import Finger
from servobus.protocols.roh.goals import write_values
from servobus.protocols.roh.hand import Hand, RegisterValue
from servobus.protocols.roh.positions import Reading, locate, rest, rests
from servobus.protocols.roh.spans import write_spans
from servobus.values import StopReport, StopTarget

REPEATS = 2
"""How often an unanswered write is sent, because a bad line may lose one."""
HOLDS = "a ROH hand has no torque command: the finger keeps holding"
NOT_ENABLED = "it was not enabled, and rests: nothing was written"
LEFT_ALONE = "it was not enabled: nothing was sent"
UNHEARD = "it was not enabled, and could not be read: whether it rests is not known"

Targets = dict[Finger, StopTarget]
Written = dict[Finger, int]
"""The raw targets that hands have confirmed."""
Failures = dict[Finger, ServobusError]
OFFLINE = ReplyTimeout("offline: nothing was confirmed")


def stop(hands: Mapping[int, Hand], targets: Sequence[tuple[Finger, StopTarget]]) -> Plan[dict[str, StopReport]]:
    """Return the plan of a stop; see above. A finger that was not enabled is held where it moves."""
    reports = yield from _hold_all(hands, {finger: target for finger, target in targets if target.enabled})
    others = {finger: target for finger, target in targets if not target.enabled}
    for finger, target in others.items():
        alone = target.leave_alone
        reports[finger.name] = StopReport("none", False, alone, LEFT_ALONE if alone else UNHEARD)
    moving: Targets = {}
    for unit, hand in hands.items():
        awake = [finger for finger, target in others.items() if target.reachable and not target.leave_alone]
        asked = [finger for finger in awake if finger.node == unit]
        resting = yield from _resting(hand, asked)
        reports |= {finger.name: StopReport("none", False, True, NOT_ENABLED) for finger, rested in resting.items() if rested}
        moving |= {finger: others[finger] for finger, rested in resting.items() if not rested}
    reports |= yield from _hold_all(hands, moving)
    return {finger.name: _with_note(reports[finger.name], target) for finger, target in targets}


def _resting(hand: Hand, fingers: Sequence[Finger]) -> Plan[dict[Finger, bool]]:
    """Return whether each of these fingers rests; nothing for a hand that cannot be read."""
    if not fingers:
        return {}
    try:
        yield from hand.attach()
        readings = yield from rest(hand, fingers)
    except ServobusError:
        return {}
    return {finger: rests(finger, *readings[finger]) for finger in fingers}


def _hold_all(hands: Mapping[int, Hand], enabled: Targets) -> Plan[dict[str, StopReport]]:
    """Hold fingers, and read whether they rest then."""
    reports: dict[str, StopReport] = {}
    written: Written = {}
    failed: Failures = {finger: OFFLINE for finger, target in enabled.items() if not target.reachable}
    for unit, hand in hands.items():
        reachable = {finger: target for finger, target in enabled.items() if finger.node == unit and target.reachable}
        if reachable:
            failed |= yield from _hold(hand, reachable, written)
    for unit, hand in hands.items():
        silent = {
            finger: enabled[finger] for finger, error in failed.items() if finger.node == unit and isinstance(error, ReplyTimeout)
        }
        yield from _write_unanswered(hand, silent, written)
    for unit, hand in hands.items():
        held = [finger for finger in written if finger.node == unit and finger not in failed]
        reports |= yield from _confirm(hand, held, written)
    return reports | {
        finger.name: StopReport("hold", finger in written, False, error.message) for finger, error in failed.items()
    }


def disable(hand: Hand, finger: Finger) -> Plan[StopReport]:
    """Hold the finger. One that was not enabled, and rests, is written nothing."""
    target = StopTarget(finger.name, "limp", enabled=finger.is_begun)
    reports = yield from stop({hand.unit: hand}, [(finger, target)])
    finger.held.targets.clear()
    return reports[finger.name]


def _hold(hand: Hand, targets: Targets, written: Written) -> Plan[Failures]:
    """Read where the fingers are, and write that. Returns the fingers that it failed for."""
    try:
        yield from hand.attach()
        expected = {finger: _expected(hand, finger, target) for finger, target in targets.items()}
        places = yield from hand.explained(locate(hand, expected))
        failed = yield from write_values(hand, [RegisterValue(finger, finger.target_name, raw) for finger, raw in places.items()])
    except ServobusError as error:
        return dict.fromkeys(targets, error)
    written |= {finger: raw for finger, raw in places.items() if finger not in failed}
    return failed


def _confirm(hand: Hand, fingers: Sequence[Finger], written: Written) -> Plan[dict[str, StopReport]]:
    if not fingers:
        return {}
    try:
        readings = yield from hand.explained(rest(hand, fingers))
    except ServobusError as error:
        detail = f"its target was written, and not read back: {error.message}"
        return {finger.name: StopReport("hold", True, False, detail) for finger in fingers}
    return {finger.name: _report(finger, written[finger], *readings[finger]) for finger in fingers}


def _report(finger: Finger, target: int, before: Reading, now: Reading) -> StopReport:
    detail = ""
    if not finger.near(target, now.target):
        detail = f"its target reads {_text(finger, now.target)} after {_text(finger, target)} was written"
    elif not rests(finger, before, now):
        detail = f"it still moves: it was read at {_text(finger, before.position)}, then at {_text(finger, now.position)}"
    return StopReport("hold", True, not detail, detail)


def _text(finger: Finger, raw: int) -> str:
    return f"{finger.calibration.to_unit(raw):.4g}"


def _with_note(report: StopReport, target: StopTarget) -> StopReport:
    limp = target.kind == "limp" and report.action == "hold" and report.confirmed
    return StopReport("hold", report.written, confirmed=True, detail=HOLDS) if limp else report


def _expected(hand: Hand, finger: Finger, target: StopTarget) -> int | None:
    """Return where a finger is expected to be read: where it is taken to be, else at its last target."""
    estimate = _estimate(hand, finger, target)
    return next(iter(finger.held.targets), None) if estimate is None else estimate


def _estimate(hand: Hand, finger: Finger, target: StopTarget) -> int | None:
    """Return where a finger is taken to be, as a raw target; None: that is not known, or not in the finger's range."""
    if target.position is None or hand.fit.obstacle:
        return None
    try:
        return finger.target_at(hand.map, target.position)
    except LimitError:
        return None


def _write_unanswered(hand: Hand, targets: Targets, written: Written) -> Plan[None]:
    """Write where the fingers of a hand that does not answer are taken to be, as far as they were on their way."""
    model = hand.map
    places = {finger: raw for finger, target in targets.items() if (raw := _estimate(hand, finger, target)) is not None}
    by_address = {
        finger.address(model, finger.target_name): RegisterValue(finger, finger.target_name, raw)
        for finger, raw in places.items()
        if not any(finger.near(goal, raw) for goal in finger.held.targets)
    }
    for span in write_spans(by_address, hand.limits.write):
        group = [by_address[address] for address in range(span.start, span.end)]
        for value in group:
            value.finger.held.before_write(value.name, value.raw)
            written[value.finger] = value.raw
        registers = [model.named(value.name).to_word(value.raw) for value in group]
        for _ in range(REPEATS):
            yield from ask(UnansweredWrite(hand.timing, hand.unit, span.start, registers))
