"""How a FEETECH line is stopped: each servo by the rule of the mode it is in, and confirmed by reading the effect.

| what is stopped | is written | is confirmed when |
|---|---|---|
| limp, whatever the mode | torque 0 | torque reads 0 |
| hold, torque reads 0 | nothing: a hold never energises | at once |
| hold, position | goal := the present position just read | goal reads so, and the joint is there |
| hold, position, outside its stored limits | torque 0 | torque reads 0 |
| hold, velocity | speed 0 | the goal speed reads 0 |
| hold, pwm or motor | PWM word 0 | the word reads 0 |
| hold, step | 0 steps to go | two readings of the position are equal; torque 0 where they are not |
| hold, any other mode, or a servo that is not identified | torque 0 | torque reads 0 |

1. At once, without a question: torque 0 for who goes limp, speed 0 and PWM 0 where these rule, and the estimate of the present
   position for an enabled servo that is offline. SYNC WRITE frames have no reply, so each is sent twice, here and below.
2. In rounds: each servo that is not confirmed yet is read (mode, torque, goal, position in one turn; one SYNC READ for those that
   know it), and what its rule asks for is written straight after. A round reads anew, so no old position is written again.
   A servo that does not answer gets the estimate once; it delays the others by its own turn alone.
3. Effort and acceleration of the last goal are put back, so that neither outlives this process; what we armed with REG WRITE is
   disarmed.

One reading is not believed where it surprises: a position that does not agree with the estimate, another mode than identified,
torque 0 where it was on. It is read again before anything follows from it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

from servobus.errors import ServobusError
from servobus.protocols.base import Plan, Request, ask
from servobus.protocols.model import Register
from servobus.protocols.sms.armed import Armed
from servobus.protocols.sms.goals import max_servos
from servobus.protocols.sms.options import SmsBus
from servobus.protocols.sms.reading import max_replies
from servobus.protocols.sms.requests import Read, SyncRead, SyncWrite, Write
from servobus.protocols.sms.servo import HostServo
from servobus.protocols.sms.stop_rules import ROUNDS, Registers, Stop, Writes
from servobus.values import StopReport, StopTarget

REPEATS = 2
"""Times an unanswered frame is sent, because a lossy line may lose one."""
Targets = Sequence[tuple[HostServo, StopTarget]]


class Stopper:
    """The plans that stop servos of one bus."""

    def __init__(self, options: SmsBus, armed: Armed) -> None:
        self.options = options
        self._armed = armed

    def stop(self, targets: Targets) -> Plan[dict[str, StopReport]]:
        """Return the plan that stops these servos and reports each."""
        stops = [Stop(servo, target) for servo, target in targets]
        for frame in self._at_once(stops):
            yield from ask(frame)
        for number in range(ROUNDS):
            for group in self._groups([stop for stop in stops if stop.pending]):
                yield from self._round(group, number)
        for servo in [stop.servo for stop in stops if stop.report.confirmed and stop.target.enabled]:
            with suppress(ServobusError):
                own = {name: raw for name, raw in servo.own.items() if getattr(servo.options, name) is None}
                yield from self._put_back(servo, own)
        yield from self._armed.disarm_ours([stop.servo.node for stop in stops if stop.target.reachable and not stop.silences])
        return {stop.servo.name: stop.report for stop in stops}

    def preview(self, targets: Targets) -> Sequence[Request[Any]]:
        """Return the frames that leave at once, the first question to each other servo, and the holds that follow from it."""
        stops = [Stop(servo, target) for servo, target in targets]
        at_once = self._at_once(stops)
        questions = [_question(group, 0) for group in self._groups([stop for stop in stops if not stop.report.written])]
        holds = [(stop.servo, write) for stop in stops if (write := stop.estimate()) is not None]
        return [*at_once, *questions, *self._twice(holds)]

    def blind(self, servo: HostServo, target: StopTarget) -> Sequence[Request[Any]]:
        """Return what stops a servo that does not answer, and may be sent for ever."""
        write = Stop(servo, target).blind()
        return [] if write is None else self._frames([(servo, write)])

    def disable(self, servo: HostServo) -> Plan[StopReport]:
        """Return the plan that switches torque off and reads it back; then the servo gets back what our goals changed."""
        torque = servo.model.registers[servo.model.torque]
        yield from ask(self._write(servo, torque, 0))
        if (yield from ask(servo.read_raw(torque))):
            return StopReport("limp", True, False, "torque still reads on")
        with suppress(ServobusError):
            yield from self._put_back(servo, servo.own)
            if servo.node in self._armed and (yield from self._armed.flag(servo.node)):
                yield from self._armed.disarm(servo)
        return StopReport("limp", True, True)

    def _put_back(self, servo: HostServo, own: Mapping[str, int]) -> Plan[None]:
        """Write these settings of the servo's own where a goal has changed them."""
        for name, raw in own.items():
            if servo.held.get(name) != raw:
                yield from ask(self._write(servo, servo.model.registers[name], raw))
                servo.hold({name: raw})

    # Rounds

    def _groups(self, stops: Sequence[Stop]) -> list[list[Stop]]:
        """Return who is asked together: those that know SYNC READ and share a block. Who was silent is asked alone, and last."""
        together: dict[tuple[int, int, int], list[Stop]] = {}
        for number, stop in enumerate(sorted(stops, key=lambda stop: stop.silences)):
            alone = 0 if stop.servo.model.sync_read and not stop.silences else number + 1
            read = stop.servo.read_motion()
            together.setdefault((read.address, read.reply_key, alone), []).append(stop)
        groups = []
        for (_, size, _), members in together.items():
            count = max_replies(self.options, size)
            groups += [members[start : start + count] for start in range(0, len(members), count)]
        return groups

    def _round(self, group: Sequence[Stop], number: int) -> Plan[None]:
        """Read these servos, and write what their rules ask for."""
        yield from self._read(group, 0)
        for more in (1, 2):  # what nothing bears out is read again
            if doubtful := [stop for stop in group if stop.is_doubtful]:
                yield from self._read(doubtful, more)
        writes = [(stop.servo, write) for stop in group if (write := stop.next_write(number)) is not None]
        for frame in self._twice(writes):
            yield from ask(frame)

    def _read(self, stops: Sequence[Stop], more: int) -> Plan[None]:
        """Ask these servos, and give each its reading, or what went wrong."""
        detail = "it did not answer"
        readings: Mapping[int, Registers] = {}
        try:
            readings = yield from ask(_question(stops, more))
        except ServobusError as error:
            detail = str(error)
        for stop in stops:
            stop.take(readings.get(stop.servo.node), detail)

    # Frames

    def _at_once(self, stops: Sequence[Stop]) -> list[SyncWrite]:
        """Return what is written without a question, each frame as often as it is sent."""
        writes = [(stop.servo, write) for stop in stops if (write := stop.at_once()) is not None]
        return self._twice(writes)

    def _twice(self, writes: Sequence[tuple[HostServo, Writes]]) -> list[SyncWrite]:
        """Return the frames that carry these writes, each as often as it is sent."""
        return [frame for frame in self._frames(writes) for _ in range(REPEATS)]

    def _frames(self, writes: Sequence[tuple[HostServo, Writes]]) -> list[SyncWrite]:
        """Return the fewest SYNC WRITE frames that carry these writes."""
        spans: dict[tuple[int, int], dict[int, bytes]] = {}
        for servo, (register, raw) in writes:
            spans.setdefault((register.address, register.size), {})[servo.node] = servo.encode(register, raw)
        frames = []
        for (address, size), data_of in spans.items():
            nodes, count = list(data_of), max_servos(self.options, size)
            parts = [nodes[start : start + count] for start in range(0, len(nodes), count)]
            frames += [SyncWrite(address, {node: data_of[node] for node in part}) for part in parts]
        return frames

    def _write(self, servo: HostServo, register: Register, raw: int) -> Write:
        return Write(servo.node, register.address, servo.encode(register, raw), answered=servo.answers_writes)


def _question(stops: Sequence[Stop], more: int) -> Request[Mapping[int, Registers]]:
    """Return the read of mode, torque, goal and position of these servos, by node."""
    reads = {stop.servo.node: stop.servo.read_motion(more=more) for stop in stops}
    (node, first), *others = reads.items()
    if not others:
        decode = first.decode
        return Read(node, first.address, first.reply_key, lambda data: {node: decode(data)})
    return SyncRead(
        first.address,
        first.reply_key,
        list(reads),
        lambda data: {each: reads[each].decode(block) for each, block in data.items()},
    )
