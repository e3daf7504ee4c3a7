"""Goals and stops of KST servos: frames to one servo each, confirmed by a reply that repeats the position.

There is no speed, torque or stop command: the host ramps the setpoints and decides what may be sent, and a stop sends each
servo's last setpoint again (`CalibratedServo.hold_steps`).
"""

from __future__ import annotations

from collections.abc import Sequence

from servobus.errors import ServobusError
from servobus.protocols.base import GoalPlan, Plan, ask
from servobus.protocols.kst.aborts import HardwareFault
from servobus.protocols.kst.codec import Command, encode_position
from servobus.protocols.kst.requests import Read, RequestSettings, SetValue, UnansweredCommand
from servobus.protocols.kst.servo import CalibratedServo
from servobus.values import Outcome, StopReport, StopTarget

REPEATS = 2
"""How often an unanswered stop is sent, because a bad line may lose one."""
HOLDS = "KST has no torque command: the servo keeps holding"

Results = dict[str, Outcome | Exception]
Setpoint = tuple[CalibratedServo, int]
"""A servo and its goal in steps."""


def plan_setpoints(settings: RequestSettings, setpoints: Sequence[Setpoint], *, together: bool) -> list[GoalPlan]:
    """Return one plan for each setpoint, or one for all."""
    groups = [list(setpoints)] if together and setpoints else [[setpoint] for setpoint in setpoints]
    return [GoalPlan(tuple(servo.name for servo, _ in group), send_all(settings, group), len(group)) for group in groups]


def send_all(settings: RequestSettings, setpoints: Sequence[Setpoint]) -> Plan[Results]:
    """Send setpoints one after the other. A refusal of one servo does not stop the others."""
    results: Results = {}
    for servo, raw in setpoints:
        try:
            refuse_faulty(settings, servo)
            yield from send(settings, servo, raw)
            results[servo.name] = Outcome.ACKED
        except ServobusError as error:
            results[servo.name] = error.at(servo=servo.name)
    return results


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


def stop(settings: RequestSettings, targets: Sequence[tuple[CalibratedServo, StopTarget]]) -> Plan[dict[str, StopReport]]:
    """Hold the enabled servos, also those that are to be limp: first those that answer, then those that do not."""
    reports: dict[str, StopReport] = {}
    silent: list[tuple[CalibratedServo, StopTarget, str]] = []
    for servo, target in targets:
        if not target.enabled:
            reports[servo.name] = StopReport("none", False, True, "it was not enabled: servobus does not move it")
        elif not target.reachable:
            silent.append((servo, target, "offline: nothing was confirmed"))
        else:
            try:
                yield from _hold(settings, servo, target)
                reports[servo.name] = StopReport("hold", True, True, HOLDS if target.kind == "limp" else "")
            except ServobusError as error:
                silent.append((servo, target, str(error)))
    for servo, target, reason in silent:
        reports[servo.name] = yield from _hold_unanswered(settings, servo, target, reason)
    for servo, target in targets:
        if target.kind == "limp":
            servo.travel.end()
    return {servo.name: reports[servo.name] for servo, _ in targets}


def _hold(settings: RequestSettings, servo: CalibratedServo, target: StopTarget) -> Plan[None]:
    """Send the position to hold; read it first where it is not known. A latched hardware fault does not prevent a stop."""
    if servo.hold_steps(target.setpoint) is None:
        yield from ask(Read(settings, servo.node, Command.READ_POSITION, servo.read_steps))
    raw = servo.hold_steps(target.setpoint)
    assert raw is not None
    yield from send(settings, servo, raw)


def _hold_unanswered(settings: RequestSettings, servo: CalibratedServo, target: StopTarget, reason: str) -> Plan[StopReport]:
    raw = servo.hold_steps(target.setpoint)
    if raw is None:
        return StopReport("hold", False, False, f"{reason}; nothing was written, because its position is not known")
    servo.travel.send(raw)
    for _ in range(REPEATS):
        yield from ask(UnansweredCommand(settings, servo.node, Command.SET_POSITION, encode_position(raw)))
    return StopReport("hold", True, False, reason)


def disable(servo: CalibratedServo) -> Plan[StopReport]:
    """Send nothing: the servo keeps holding, and goals are refused from now on."""
    yield from ()
    servo.travel.end()
    return StopReport("hold", False, True, HOLDS)
