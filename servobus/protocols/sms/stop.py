"""How a FEETECH line comes to rest: first what can be written to many at once, unanswered and therefore twice; then, servo by
servo, what needs a question, and the confirmation.

Two facts shape it (feetech.md, section 9): writing a goal switches torque on by itself, so a servo that is limp is never held;
and a SYNC WRITE has no answer, so nothing counts as confirmed that was not read back or acknowledged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from servobus.errors import ServobusError
from servobus.protocols.base import Plan, ask
from servobus.protocols.model import Register
from servobus.protocols.sms.goals import split_sync_write
from servobus.protocols.sms.options import SmsBus
from servobus.protocols.sms.requests import Read, Write
from servobus.protocols.sms.servo import FittedServo
from servobus.values import StopReport, StopTarget

ROUNDS = 3
TIMES = 2
"""An unanswered frame is said twice, because a lossy line may swallow one."""


@dataclass(frozen=True, slots=True)
class Stopper:
    """The plans that stop servos of one bus."""

    options: SmsBus

    def stop(self, targets: Sequence[tuple[FittedServo, StopTarget]]) -> Plan[dict[str, StopReport]]:
        written = yield from self._write_at_once(targets)
        reports: dict[str, StopReport] = {}
        for _ in range(ROUNDS):
            # Each is asked once before any is asked again: one that does not answer must not hold up the others.
            for servo, target in targets:
                if servo.name not in reports or (target.reachable and not reports[servo.name].confirmed):
                    reports[servo.name] = yield from self._finish(servo, target, servo.name in written)
        return reports

    def disable(self, servo: FittedServo) -> Plan[StopReport]:
        register = servo.model.registers[servo.model.torque]
        yield from ask(self._write(servo, register, 0))
        confirmed = (yield from self._read(servo, register)) == 0
        return StopReport("limp", True, confirmed, "" if confirmed else "torque still reads on")

    def _write_at_once(self, targets: Sequence[tuple[FittedServo, StopTarget]]) -> Plan[set[str]]:
        """Torque off for all that shall be limp; the goal for all whose present position is known; speed 0 for all wheels."""
        spans: dict[int, dict[int, bytes]] = {}
        written = set()
        for servo, target in targets:
            try:
                register, raw = self._immediate(servo, target)
                data = servo.encode(register, raw) if register else b""
            except ServobusError:
                continue  # a position the goal register cannot hold: the question below settles it
            if register:
                spans.setdefault(register.address << 8 | register.size, {})[servo.node] = data
                written.add(servo.name)
        for span, data_of in spans.items():
            for frame in split_sync_write(self.options, span >> 8, data_of):
                for _ in range(TIMES):
                    yield from ask(frame)
        return written

    @staticmethod
    def _immediate(servo: FittedServo, target: StopTarget) -> tuple[Register | None, int]:
        """What can be written without a question: a register and its raw value."""
        if target.kind == "limp":
            return servo.model.registers[servo.model.torque], 0
        if target.enabled and servo.mode == "velocity":
            return servo.speed, 0
        if target.enabled and target.position is not None:
            return servo.position, servo.calibration.to_raw(target.position)
        return None, 0

    def _finish(self, servo: FittedServo, target: StopTarget, written: bool) -> Plan[StopReport]:
        """Ask, write what is still missing, and confirm."""
        if not target.reachable:
            return StopReport(target.kind, written, False, "offline: nothing was confirmed")
        try:
            if target.kind == "limp":
                confirmed = (yield from self._read(servo, servo.model.registers[servo.model.torque])) == 0
                return StopReport("limp", True, confirmed, "" if confirmed else "torque still reads on")
            return (yield from self._hold(servo, target))
        except ServobusError as error:
            return StopReport(target.kind, written, False, str(error))

    def _hold(self, servo: FittedServo, target: StopTarget) -> Plan[StopReport]:
        """Goal := present, acknowledged or read back. Never for a servo that is limp."""
        if not (yield from self._read(servo, servo.model.registers[servo.model.torque])):
            return StopReport("none", False, True, "it was limp" + (": it has restarted" if target.enabled else ""))
        if servo.mode == "velocity":
            register, raw = servo.speed, 0
        else:
            present = servo.model.registers[servo.model.state["position"]]
            register, raw = servo.position, (yield from self._read(servo, present))
        yield from ask(self._write(servo, register, raw))
        confirmed = self.options.status_return == "all" or (yield from self._read(servo, register)) == raw
        return StopReport("hold", True, confirmed, "" if confirmed else f"{register.name} does not read back")

    def _write(self, servo: FittedServo, register: Register, raw: int) -> Write:
        answered = self.options.status_return == "all"
        return Write(servo.node, register.address, servo.encode(register, raw), answered=answered)

    @staticmethod
    def _read(servo: FittedServo, register: Register) -> Plan[int]:
        return (yield from ask(Read(servo.node, register.address, register.size, lambda data: servo.decode(register, data))))
