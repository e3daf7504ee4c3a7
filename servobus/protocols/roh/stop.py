"""Stops of fingers: target := present position. A hand has no torque command, so its fingers keep holding.

A stop has three steps:

1. Write the targets of all fingers whose present position is fresh enough; nothing is asked for that.
2. Read the present positions of the hands that answer, and write them as targets again, acknowledged.
3. Write to the hands that do not answer, twice and without waiting for a reply. They come last, so they delay nobody.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from servobus.errors import LimitError, ServobusError
from servobus.protocols.base import Plan, ask
from servobus.protocols.modbus.requests import UnansweredWrite
from servobus.protocols.roh.finger import Finger
from servobus.protocols.roh.goals import write_values
from servobus.protocols.roh.hand import Hand, RegisterValue
from servobus.protocols.roh.model import RohModel
from servobus.protocols.roh.spans import write_spans
from servobus.values import StopReport, StopTarget

REPEATS = 2
"""How often an unanswered write is sent, because a bad line may lose one."""
HOLDS = "a ROH hand has no torque command: the finger keeps holding"
NOT_ENABLED = "it was not enabled: servobus does not move it"

Targets = Sequence[tuple[Finger, StopTarget]]


def stop(hands: Mapping[int, Hand], targets: Targets) -> Plan[dict[str, StopReport]]:
    """Return the plan of a stop; see above."""
    reports = {finger.name: StopReport("none", False, True, NOT_ENABLED) for finger, target in targets if not target.enabled}
    enabled = [(finger, target) for finger, target in targets if target.enabled]
    present = {unit: [pair for pair in enabled if pair[0].node == unit and pair[1].reachable] for unit in hands}
    absent = {unit: [pair for pair in enabled if pair[0].node == unit and not pair[1].reachable] for unit in hands}
    written: set[Finger] = set()
    for unit, some in present.items():
        values = _fresh_targets(hands[unit], some)
        failed = yield from write_values(hands[unit], values)
        written |= {value.finger for value in values} - set(failed)
    for unit, some in present.items():
        reports |= yield from _hold(hands[unit], some, written)
    for unit, some in absent.items():
        reports |= yield from _write_unanswered(hands[unit], some)
    return {finger.name: reports[finger.name] for finger, _ in targets}


def disable() -> Plan[StopReport]:
    """Send nothing: the finger keeps holding, and goals are refused from now on."""
    yield from ()
    return StopReport("hold", False, True, HOLDS)


def _fresh_targets(hand: Hand, targets: Targets) -> list[RegisterValue]:
    """Return the targets that can be written without a question."""
    values = []
    for finger, target in targets:
        raw = None if target.position is None or hand.fit.obstacle else _raw_target(finger, hand.map, target.position)
        if raw is not None:
            values.append(RegisterValue(finger, finger.target_name, raw))
    return values


def _raw_target(finger: Finger, model: RohModel, position: float) -> int | None:
    try:
        return finger.target_at(model, position)
    except LimitError:
        return None  # slightly outside the map's range: step 2 writes what the hand itself reports


def _hold(hand: Hand, targets: Targets, written: set[Finger]) -> Plan[dict[str, StopReport]]:
    """Read where the fingers are, and write that."""
    failed: dict[Finger, ServobusError] = {}
    try:
        yield from hand.attach()
        positions = yield from hand.explained(hand.read_values({finger: (finger.position_name,) for finger, _ in targets}))
        failed = yield from write_values(hand, [RegisterValue(p.finger, p.finger.target_name, p.raw) for p in positions])
    except ServobusError as error:
        failed = {finger: error for finger, _ in targets}
    return {finger.name: _report(finger, target, failed.get(finger), written) for finger, target in targets}


def _report(finger: Finger, target: StopTarget, error: ServobusError | None, written: set[Finger]) -> StopReport:
    if error is not None:
        return StopReport("hold", finger in written, False, error.message)
    return StopReport("hold", True, True, HOLDS if target.kind == "limp" else "")


def _write_unanswered(hand: Hand, targets: Targets) -> Plan[dict[str, StopReport]]:
    """Write the last positions of the fingers of a hand that does not answer, where they are known."""
    model = hand.map
    by_address = {value.finger.address(model, value.name): value for value in _fresh_targets(hand, targets)}
    for span in write_spans(by_address, hand.limits.write):
        group = [by_address[address] for address in range(span.start, span.end)]
        for value in group:
            value.finger.held.before_write(value.name, value.raw)
        for _ in range(REPEATS):
            registers = [model.named(value.name).to_word(value.raw) for value in group]
            yield from ask(UnansweredWrite(hand.timing, hand.unit, span.start, registers))
    written = {value.finger for value in by_address.values()}
    return {
        finger.name: StopReport(
            "hold",
            finger in written,
            False,
            "offline: nothing was confirmed"
            if finger in written
            else "offline, and its position is not known: nothing was written",
        )
        for finger, _ in targets
    }
