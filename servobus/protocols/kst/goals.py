"""How goals reach KST servos, and how they come to rest: addressed frames, each confirmed by its echo.

There is no speed, torque or stop command (the host paces goals and keeps the gate), so a stop says once more where each servo
was last sent. Setpoints are a step of the host's pace apart, so that is where it is, or nearly.
"""

from __future__ import annotations

from collections.abc import Sequence

from servobus.errors import ReplyTimeout, ServobusError
from servobus.protocols.base import GoalPlan, Plan, ask
from servobus.protocols.kst.aborts import HardwareFault
from servobus.protocols.kst.codec import Command, encode_position
from servobus.protocols.kst.requests import Confirmed, FrameTiming, Read, Tell
from servobus.protocols.kst.servo import FittedServo
from servobus.values import Outcome, StopReport, StopTarget

TIMES = 2
"""What is not answered is said twice, because a lossy line may swallow one."""
HOLDS = "KST has no torque command: the servo keeps holding"

Results = dict[str, Outcome | Exception]
Step = tuple[FittedServo, int]
"""A servo and where it shall go, in steps."""


def turns(timing: FrameTiming, steps: Sequence[Step], *, together: bool) -> list[GoalPlan]:
    """One turn for each goal, or one plan for all."""
    groups = [list(steps)] if together and steps else [[step] for step in steps]
    return [GoalPlan(tuple(servo.name for servo, _ in group), set_all(timing, group), len(group)) for group in groups]


def set_all(timing: FrameTiming, steps: Sequence[Step]) -> Plan[Results]:
    """One after the other; what one refuses does not keep the others."""
    results: Results = {}
    for servo, raw in steps:
        try:
            yield from set_position(timing, servo, raw)
            results[servo.name] = Outcome.ACKED
        except ServobusError as error:
            results[servo.name] = error.at(servo=servo.name)
    return results


def set_position(timing: FrameTiming, servo: FittedServo, raw: int) -> Plan[None]:
    """Raises HardwareFault, unsent, while one is latched."""
    refuse_faulty(timing, servo)
    try:
        yield from ask(Confirmed(timing, servo.node, Command.SET_POSITION, encode_position(raw)))
    except ReplyTimeout:
        servo.sent(raw)  # it may have been obeyed
        raise
    servo.sent(raw)
    servo.confirmed(raw)


def refuse_faulty(timing: FrameTiming, servo: FittedServo) -> None:
    if servo.node in timing.aborts.faulty:
        raise HardwareFault(
            "the servo has reported a hardware fault (0606 0000): nothing was sent. Look after it, then enable it again",
            code=0x06060000,
            servo=servo.name,
        )


def stop(timing: FrameTiming, targets: Sequence[tuple[FittedServo, StopTarget]]) -> Plan[dict[str, StopReport]]:
    """Hold, also in place of limp. First the servos that answer; then, twice and unanswered, those that do not."""
    reports: dict[str, StopReport] = {}
    silent: list[tuple[FittedServo, str]] = []
    for servo, target in targets:
        if not target.enabled:
            reports[servo.name] = StopReport("none", False, True, "it was not enabled: nothing of ours moves it")
        elif not target.reachable:
            silent.append((servo, "offline: nothing was confirmed"))
        else:
            try:
                yield from _hold(timing, servo)
                reports[servo.name] = StopReport("hold", True, True, HOLDS if target.kind == "limp" else "")
            except ServobusError as error:
                silent.append((servo, str(error)))
        if target.kind == "limp":
            servo.disabled()
    for servo, reason in silent:
        reports[servo.name] = yield from _hold_unheard(timing, servo, reason)
    return {servo.name: reports[servo.name] for servo, _ in targets}


def _hold(timing: FrameTiming, servo: FittedServo) -> Plan[None]:
    """Goal := resting place, which is asked for where it is not known. A latched hardware fault does not keep it back."""
    if servo.resting_place is None:
        yield from ask(Read(timing, servo.node, Command.READ_POSITION, servo.position_of))
    raw = servo.resting_place
    assert raw is not None
    yield from ask(Confirmed(timing, servo.node, Command.SET_POSITION, encode_position(raw)))
    servo.sent(raw)
    servo.confirmed(raw)


def _hold_unheard(timing: FrameTiming, servo: FittedServo, reason: str) -> Plan[StopReport]:
    raw = servo.resting_place
    if raw is None:
        return StopReport("hold", False, False, f"{reason}; nothing was written, for its position is not known")
    for _ in range(TIMES):
        yield from ask(Tell(timing, servo.node, Command.SET_POSITION, encode_position(raw)))
    return StopReport("hold", True, False, reason)


def disable(servo: FittedServo) -> Plan[StopReport]:
    """The host's gate closes, and nothing is said."""
    yield from ()
    servo.disabled()
    return StopReport("hold", False, True, HOLDS)
