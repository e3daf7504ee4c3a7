"""How a FEETECH line is stopped.

The cases:
1. A servo that must be limp gets torque 0 at once.
2. An enabled servo in wheel mode gets speed 0 at once.
3. An enabled servo whose present position is known gets that position as goal at once.
These leave in SYNC WRITE frames, which have no reply, so each is sent twice. Then the reachable servos are asked one by one, in
up to three rounds: a limp one must read torque 0; one with torque on gets its present position as goal and acknowledges it.
Writing a goal switches torque on, so a servo whose torque is off is never written to. Nothing counts as confirmed that was not
read back or acknowledged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from servobus.errors import ServobusError
from servobus.protocols.base import Plan, Request, ask
from servobus.protocols.model import Register
from servobus.protocols.sms.goals import max_servos
from servobus.protocols.sms.options import SmsBus
from servobus.protocols.sms.requests import SyncWrite, Write
from servobus.protocols.sms.servo import HostServo
from servobus.values import StopReport, StopTarget

ROUNDS = 3
REPEATS = 2
"""Times an unanswered frame is sent, because a lossy line may lose one."""

Targets = Sequence[tuple[HostServo, StopTarget]]


@dataclass(frozen=True, slots=True)
class Stopper:
    """The plans that stop servos of one bus."""

    options: SmsBus

    def stop(self, targets: Targets) -> Plan[dict[str, StopReport]]:
        """Return the plan that stops these servos and reports each."""
        frames, written = self._frames_at_once(targets)
        for frame in frames:
            yield from ask(frame)
        reports: dict[str, StopReport] = {}
        for _ in range(ROUNDS):
            # Each servo is asked once before any is asked again, so one that does not answer delays the others only once.
            for servo, target in targets:
                if servo.name not in reports or (target.reachable and not reports[servo.name].confirmed):
                    reports[servo.name] = yield from self._finish(servo, target, servo.name in written)
        return reports

    def preview(self, targets: Targets) -> Sequence[Request[Any]]:
        """Return the frames that leave before the first reply is awaited, or the first question to each servo."""
        frames, _ = self._frames_at_once(targets)
        return frames or [servo.read_raw(servo.model.registers[servo.model.torque]) for servo, _ in targets]

    def disable(self, servo: HostServo) -> Plan[StopReport]:
        """Return the plan that switches torque off and reads it back."""
        register = servo.model.registers[servo.model.torque]
        yield from ask(self._write(servo, register, 0))
        return (yield from self._limp_report(servo))

    def _frames_at_once(self, targets: Targets) -> tuple[list[SyncWrite], set[str]]:
        """Return what is written without a question, each frame as often as it is sent, and the names of the servos in it."""
        spans: dict[tuple[int, int], dict[int, bytes]] = {}
        written = set()
        for servo, target in targets:
            try:
                register, raw = _immediate(servo, target)
                data = servo.encode(register, raw) if register else b""
            except ServobusError:
                continue  # the goal register cannot hold this position: the servo is asked for it below
            if register:
                spans.setdefault((register.address, register.size), {})[servo.node] = data
                written.add(servo.name)
        frames: list[SyncWrite] = []
        for (address, size), data_of in spans.items():
            nodes, count = list(data_of), max_servos(self.options, size)
            for start in range(0, len(nodes), count):
                frame = SyncWrite(address, {node: data_of[node] for node in nodes[start : start + count]})
                frames += [frame] * REPEATS
        return frames, written

    def _finish(self, servo: HostServo, target: StopTarget, written: bool) -> Plan[StopReport]:
        """Ask, write what is still missing, and confirm."""
        if not target.reachable:
            return StopReport(target.kind, written, False, "offline: nothing was confirmed")
        try:
            if target.kind == "limp":
                return (yield from self._limp_report(servo))
            return (yield from self._hold(servo, target))
        except ServobusError as error:
            return StopReport(target.kind, written, False, str(error))

    def _limp_report(self, servo: HostServo) -> Plan[StopReport]:
        confirmed = (yield from ask(servo.read_raw(servo.model.registers[servo.model.torque]))) == 0
        return StopReport("limp", True, confirmed, "" if confirmed else "torque still reads on")

    def _hold(self, servo: HostServo, target: StopTarget) -> Plan[StopReport]:
        """Goal := present, acknowledged or read back. Never for a servo that is limp."""
        if not (yield from ask(servo.read_raw(servo.model.registers[servo.model.torque]))):
            return StopReport("none", False, True, "it was limp" + (": it has restarted" if target.enabled else ""))
        if servo.fit.mode == "velocity":
            register, raw = servo.speed, 0
        else:
            present = servo.model.registers[servo.model.state["position"]]
            register, raw = servo.position, (yield from ask(servo.read_raw(present)))
        yield from ask(self._write(servo, register, raw))
        confirmed = self.options.writes_answered or (yield from ask(servo.read_raw(register))) == raw
        return StopReport("hold", True, confirmed, "" if confirmed else f"{register.name} does not read back")

    def _write(self, servo: HostServo, register: Register, raw: int) -> Write:
        return Write(servo.node, register.address, servo.encode(register, raw), answered=self.options.writes_answered)


def _immediate(servo: HostServo, target: StopTarget) -> tuple[Register | None, int]:
    """Return what can be written without a question: a register and its raw value; None: nothing."""
    if target.kind == "limp":
        return servo.model.registers[servo.model.torque], 0
    if target.enabled and servo.fit.mode == "velocity":
        return servo.speed, 0
    if target.enabled and target.position is not None:
        return servo.position, servo.calibration.to_raw(target.position)
    return None, 0
