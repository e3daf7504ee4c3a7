"""Goals and stops of KST servos: frames to one servo each, confirmed by a reply that repeats the position.

There is no speed, torque or stop command: the host ramps the setpoints and decides what may be sent. Before each setpoint the
servo is read, and it is sent at most one step of the ramp ahead of that (`CalibratedServo.ahead`).

A stop has three steps, and each servo that fails one of them is left to the next try of the stop:

1. Read where the servo is.
2. Send it the position to hold (`CalibratedServo.hold_steps`).
3. Read it twice, with a pause between: only a servo that rests is confirmed, because the reply repeats what was sent, whatever
   the servo does.

A servo that does not answer is sent nothing. It goes no farther than its last setpoint, one step of the ramp away, and if it has
restarted meanwhile, a position would move it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from servobus.errors import DeviceError, NotEnabled, ServobusError
from servobus.protocols.base import GoalPlan, Plan, ask
from servobus.protocols.kst.aborts import HardwareFault
from servobus.protocols.kst.codec import Command, encode_position
from servobus.protocols.kst.position import Readings, locate, rest, rests
from servobus.protocols.kst.requests import RequestSettings, SetValue
from servobus.protocols.kst.servo import CalibratedServo
from servobus.values import Outcome, ServoGoal, StopReport, StopTarget

HOLDS = "KST has no torque command: the servo keeps holding"
OFFLINE = "offline: nothing was sent; it goes no farther than its last setpoint"
NOT_ENABLED = "it was not enabled, and rests: nothing was sent"
LEFT_ALONE = "it was not enabled: nothing was sent"
UNHEARD = "it was not enabled, and could not be read: whether it rests is not known"
MAX_WAITS = 50
"""Setpoints in a row that a servo may let pass without coming nearer to the goal that it holds."""

Results = dict[str, Outcome | Exception]
Setpoint = tuple[CalibratedServo, ServoGoal, int]
"""A servo, its goal, and that in steps."""


def plan_setpoints(settings: RequestSettings, setpoints: Sequence[Setpoint], *, together: bool) -> list[GoalPlan]:
    """Return one plan for each setpoint, or one for all."""
    groups = [list(setpoints)] if together and setpoints else [[setpoint] for setpoint in setpoints]
    return [GoalPlan(tuple(servo.name for servo, _, _ in group), send_all(settings, group), len(group)) for group in groups]


def send_all(settings: RequestSettings, setpoints: Sequence[Setpoint]) -> Plan[Results]:
    """Send setpoints one after the other. A refusal of one servo does not stop the others."""
    results: Results = {}
    for servo, goal, raw in setpoints:
        try:
            refuse_faulty(settings, servo)
            if goal.lead is None:
                yield from send(settings, servo, raw)
            else:
                yield from lead(settings, servo, goal, raw)
            results[servo.name] = Outcome.ACKED
        except ServobusError as error:
            results[servo.name] = error.at(servo=servo.name)
    return results


def lead(settings: RequestSettings, servo: CalibratedServo, goal: ServoGoal, wanted: int) -> Plan[None]:
    """Read the servo, then send it a setpoint at most one lead ahead, and note that in the goal where it is nearer than wanted.

    It is not read again where a verification has just done that. A servo that lags behind its goal is sent nothing, and one that
    comes no nearer is given up.
    """
    assert goal.lead is not None
    travel = servo.travel
    present = travel.last if travel.verified else None
    travel.verified = False
    if present is None:
        present = yield from locate(settings, servo)
    if travel.jumped:
        raise NotEnabled(f"it is at {servo.to_unit(present):g}, where it was not sent: it has restarted. Enable it again")
    servo.begin_lead(goal.lead)
    raw = servo.ahead(wanted, present)
    if raw is None:
        goal.applied = _wait(servo, present)
        return
    if raw != wanted:
        goal.applied = servo.to_unit(raw)
    yield from send(settings, servo, raw)


def _wait(servo: CalibratedServo, present: int) -> float:
    """Leave a servo its goal, to which it is on its way, and return that. Raises DeviceError where it comes no nearer."""
    held = servo.travel.held
    assert held is not None
    servo.travel.wait(abs(held - present))
    if servo.travel.waits < MAX_WAITS:
        return servo.to_unit(held)
    raise DeviceError(
        f"it does not follow: it is at {servo.to_unit(present):g} and its goal is {servo.to_unit(held):g}. Is it blocked, or "
        "overloaded? Enable it again"
    )


def send(settings: RequestSettings, servo: CalibratedServo, raw: int) -> Plan[None]:
    """Send one setpoint and check its confirmation."""
    servo.travel.send(raw)
    yield from ask(set_position(settings, servo, raw))
    servo.travel.confirm(raw)


def set_position(settings: RequestSettings, servo: CalibratedServo, raw: int) -> SetValue:
    return SetValue(settings, servo.node, Command.SET_POSITION, encode_position(raw))


def refuse_faulty(settings: RequestSettings, servo: CalibratedServo) -> None:
    """Raise HardwareFault while one is latched."""
    if servo.node in settings.aborts.faulty:
        raise HardwareFault(
            "the servo has reported a hardware fault (0606 0000): nothing was sent. Check it, then enable it again",
            code=0x06060000,
            servo=servo.name,
        )


def verify(settings: RequestSettings, servo: CalibratedServo) -> Plan[None]:
    """Find out whether the servo is where it was sent. One that cannot be read has shown nothing."""
    try:
        yield from locate(settings, servo)
    except ServobusError:
        return
    servo.travel.verified = True


def enable(settings: RequestSettings, servo: CalibratedServo) -> Plan[float]:
    """Read the position, and write nothing: there is no torque command, and to write a reading that is not the servo's goal would
    move it. Raises DeviceError for a servo that moves."""
    readings = (yield from rest(settings, [servo]))[servo]
    if isinstance(readings, ServobusError):
        raise readings
    if not rests(readings):
        raise DeviceError(f"it moves, {_describe(servo, readings)}: enable it when it rests")
    raw = servo.believe(readings[1], sure=True)
    settings.aborts.faulty.discard(servo.node)
    servo.travel.begin(raw)
    return servo.to_unit(raw)


def stop(settings: RequestSettings, targets: Sequence[tuple[CalibratedServo, StopTarget]]) -> Plan[dict[str, StopReport]]:
    """Hold the servos, also those that are to be limp; see above. One that was not enabled is held where it moves."""
    reports = yield from _hold_all(settings, [(servo, target) for servo, target in targets if target.enabled])
    others = {servo: target for servo, target in targets if not target.enabled}
    for servo, target in others.items():
        alone = target.leave_alone
        reports[servo.name] = StopReport("none", False, alone, LEFT_ALONE if alone else UNHEARD)
    moving: list[tuple[CalibratedServo, StopTarget]] = []
    asked = [servo for servo, target in others.items() if target.reachable and not target.leave_alone]
    for servo, readings in (yield from rest(settings, asked)).items():
        if rests(readings):
            reports[servo.name] = StopReport("none", False, True, NOT_ENABLED)
        elif not isinstance(readings, ServobusError):
            moving.append((servo, others[servo]))
    reports |= yield from _hold_all(settings, moving)
    for servo, target in targets:
        if target.kind == "limp":
            servo.travel.end()
    return {servo.name: _with_note(reports[servo.name], target) for servo, target in targets}


def _hold_all(settings: RequestSettings, targets: Sequence[tuple[CalibratedServo, StopTarget]]) -> Plan[dict[str, StopReport]]:
    """Hold servos, and read whether they rest then."""
    reports: dict[str, StopReport] = {}
    held: list[CalibratedServo] = []
    for servo, target in targets:
        if not target.reachable:
            reports[servo.name] = StopReport("hold", False, False, OFFLINE)
        else:
            try:
                yield from _hold(settings, servo, target)
                held.append(servo)
            except ServobusError as error:
                reports[servo.name] = StopReport("hold", False, False, error.message)
    for servo, readings in (yield from rest(settings, held)).items():
        reports[servo.name] = _report(servo, readings)
    return reports


def _hold(settings: RequestSettings, servo: CalibratedServo, target: StopTarget) -> Plan[None]:
    """Read where it is, and send the position to hold. A latched hardware fault does not prevent a stop."""
    yield from locate(settings, servo)
    raw = servo.hold_steps(target.setpoint)
    assert raw is not None
    yield from send(settings, servo, raw)


def _report(servo: CalibratedServo, readings: Readings) -> StopReport:
    if isinstance(readings, ServobusError):
        return StopReport("hold", True, False, f"it was sent the position to hold, and not read again: {readings.message}")
    confirmed = rests(readings)
    return StopReport("hold", True, confirmed, "" if confirmed else f"it still moves: {_describe(servo, readings)}")


def _describe(servo: CalibratedServo, readings: tuple[int, int]) -> str:
    return f"it was read at {servo.to_unit(readings[0]):g}, then at {servo.to_unit(readings[1]):g}"


def _with_note(report: StopReport, target: StopTarget) -> StopReport:
    return replace(report, detail=HOLDS) if target.kind == "limp" and report.confirmed and not report.detail else report


def disable(settings: RequestSettings, servo: CalibratedServo) -> Plan[StopReport]:
    """Hold the servo. One that was not enabled, and rests, is sent nothing."""
    target = StopTarget(servo.name, "limp", enabled=servo.travel.range is not None)
    return (yield from stop(settings, [(servo, target)]))[servo.name]
