"""The stop of one FEETECH servo: what its mode asks for, and what confirms it. `stop` has the table, and asks the servos."""

from __future__ import annotations

from collections.abc import Mapping

from servobus.protocols.model import Register
from servobus.protocols.sms.servo import UNKNOWN, HostServo
from servobus.values import StopReport, StopTarget

ROUNDS = 6
REST_ROUND = 2
"""The round in which a servo in step mode that still does not rest goes limp."""
MAX_SILENCES = 3
"""Times a servo that does not answer is asked."""
NEAR = 40
"""Steps by which a reading may differ from the estimate, and a joint from its goal after a hold (it needs some way to stop)."""

Registers = Mapping[str, int]
Writes = tuple[Register, int]
"""A register and its raw value."""


class Stop:
    """The stop of one servo, as far as it has come."""

    __slots__ = ("_before", "_blind", "_goal", "_readings", "report", "servo", "silences", "target")

    def __init__(self, servo: HostServo, target: StopTarget) -> None:
        self.servo = servo
        self.target = target
        self.silences = 0
        self._before: Registers | None = None
        """What was read in the round before."""
        self._readings: list[Registers] = []
        """What was read in this round, the newest last; empty: it did not answer."""
        self._goal: int | None = None
        """The position that was last written as goal."""
        self._blind = False
        """The estimate was written already."""
        detail = "" if target.reachable else "offline: nothing was confirmed"
        self.report = StopReport(target.kind, False, False, detail)

    @property
    def pending(self) -> bool:
        """Whether there is something left to ask."""
        return self.target.reachable and not self.report.confirmed and self.silences < MAX_SILENCES

    # Without a question

    def at_once(self) -> Writes | None:
        """Return what is written before anything is asked; None: nothing."""
        mode, target = self._mode(None), self.target
        ours = target.kind == "limp" or mode in ("pwm", "motor") or (target.enabled and mode == "velocity")
        write = self.blind() if ours or not target.reachable else None
        if write == self._torque_off and target.kind == "hold":
            reason = self._why_not_held(UNKNOWN)
            self._report("limp", confirmed=False, detail=f"offline: torque off was written, and not confirmed: {reason}")
        if write is None and not target.reachable:
            write = self.estimate()
        return self._written(write)

    def blind(self) -> Writes | None:
        """Return what may be written for ever to a servo that does not answer: never a position."""
        if self._goes_limp:
            return self._torque_off
        return self._rest_of(self._mode(None))

    def estimate(self) -> Writes | None:
        """Return the estimate of the present position as a goal, once, for a servo that was energised when it was last heard."""
        target, servo = self.target, self.servo
        if self._blind or self._goes_limp or not target.enabled or target.position is None or servo.fit.mode != "position":
            return None
        raw = servo.calibration.to_raw(target.position)
        low, high = servo.position.raw_range
        if not low <= raw <= high:
            return None
        self._blind = True
        return servo.position, raw

    # What was read

    def take(self, motion: Registers | None, detail: str) -> None:
        """Take a reading of this round; None: there was none, for this reason."""
        if motion is None:
            self.silences += 1
            self._readings = []
            self._report(self.report.action, confirmed=False, detail=detail)
            return
        self.silences = 0
        self._readings.append(motion)

    @property
    def is_doubtful(self) -> bool:
        """Whether nothing bears out the last reading: neither what is known of the servo nor another reading."""
        return bool(self._readings) and (self._is_odd or self._is_elsewhere)

    @property
    def _is_odd(self) -> bool:
        """Whether another mode than known, or torque 0 where it was on, was read once only."""
        *others, last = map(self._state_of, self._readings)
        expected = [(self._mode(None), True)]
        if not (self.target.enabled or self.target.energised) or self._goes_limp:
            expected.append((self._mode(None), False))
        return last not in (*expected, *others)

    @property
    def _is_elsewhere(self) -> bool:
        """Whether a position is needed, and was read where nothing else has it."""
        *others, last = self._readings
        if not self._holds_position(last):
            return False
        name, estimate = self.servo.model.state["position"], self.target.position
        witnesses = [reading[name] for reading in others]
        witnesses += [] if estimate is None else [self.servo.calibration.to_raw(estimate)]
        witnesses += [] if self._goal is None else [self._goal]
        return not any(abs(last[name] - witness) <= NEAR for witness in witnesses)

    def next_write(self, number: int) -> Writes | None:
        """Return what this round writes after it has read; None: nothing. The report says what is confirmed."""
        if not self._readings:
            return self._written(self._torque_off if self._goes_limp else self.estimate())
        odd, readings, self._readings = self._is_odd, self._readings, []
        if odd:
            return self._report(self.report.action, confirmed=False, detail="mode and torque read differently each time")
        before, self._before = self._before, readings[-1]
        positions = [reading[self.servo.model.state["position"]] for reading in readings]
        return self._written(self._rule(readings[-1], before, positions, number))

    def _rule(self, motion: Registers, before: Registers | None, positions: list[int], number: int) -> Writes | None:
        if self._goes_limp:
            return self._limp(motion, "torque still reads on")
        if not motion[self.servo.model.torque]:
            return self._report("none", confirmed=True, detail=self._why_limp(motion))
        if self._blind and motion[self.servo.model.sentinel.name] == self.servo.model.sentinel.reset:
            return self._limp(motion, "it had restarted, and the blind hold energised it: torque was switched off")
        mode = self._mode(motion)
        if mode == "position":
            return self._hold(motion, positions)
        if mode == "step":
            return self._end_steps(motion, before, number)
        write = self._rest_of(mode)
        if write == self._torque_off:
            return self._limp(motion, f"its torque was switched off: {self._why_not_held(mode)}")
        if write is None or motion[write[0].name] == write[1]:
            return self._report("hold", confirmed=True)
        self._report("hold", confirmed=False, detail=f"{write[0].name} does not read {write[1]}")
        return write

    # The rules

    def _limp(self, motion: Registers, detail: str) -> Writes | None:
        """Torque 0 for as long as it is on."""
        if not motion[self.servo.model.torque]:
            return self._report("limp", confirmed=True, detail="" if self.target.kind == "limp" else self.report.detail)
        self._report("limp", confirmed=False, detail=detail)
        return self._torque_off

    def _hold(self, motion: Registers, positions: list[int]) -> Writes | None:
        """Goal := present, until the goal reads so and the joint is there.

        Torque 0 where the joint is outside its stored limits: whatever its goal is, the servo drives it to them.
        """
        register, present = self.servo.position, motion[self.servo.model.state["position"]]
        low, high = self.servo.fit.raw_limits or register.raw_range
        if not low - NEAR <= present <= high + NEAR:
            return self._limp(motion, self._why_outside(present))
        if self._goal is not None and motion[register.name] == self._goal and abs(present - self._goal) <= NEAR:
            return self._report("hold", confirmed=True)
        detail = "" if self._goal is None else f"{register.name} does not read back, or the joint is not there"
        self._report("hold", confirmed=False, detail=detail)
        self._goal = max(low, min(high, sorted(positions)[1] if len(positions) > 2 else present))
        return register, self._goal

    def _end_steps(self, motion: Registers, before: Registers | None, number: int) -> Writes | None:
        """0 steps to go; torque 0 where it does not rest all the same."""
        state = self.servo.model.state
        position, moving = state["position"], state.get("moving", "")
        if before is not None and before[position] == motion[position] and not motion.get(moving, 0):
            return self._report("hold", confirmed=True)
        if number < REST_ROUND:
            self._report("hold", confirmed=False, detail="it does not rest")
            return (self.servo.position, 0) if before is None else None
        return self._limp(motion, "it did not rest in step mode: torque was switched off")

    # Parts

    @property
    def _goes_limp(self) -> bool:
        """Whether torque off is wanted, or has been written in this stop: no position may switch it on again."""
        return "limp" in (self.target.kind, self.report.action)

    @property
    def _torque_off(self) -> Writes:
        return self.servo.model.registers[self.servo.model.torque], 0

    def _state_of(self, motion: Registers) -> tuple[str, bool]:
        """Return mode, and whether torque is on."""
        return self._mode(motion), motion[self.servo.model.torque] != 0

    def _mode(self, motion: Registers | None) -> str:
        """Return the mode that was just read, or the one that was identified."""
        fit = self.servo.fit
        if not fit.identified or fit.mode == UNKNOWN:
            return UNKNOWN
        return fit.mode if motion is None else self.servo.model.mode(motion)

    def _holds_position(self, motion: Registers) -> bool:
        return self.target.kind == "hold" and motion[self.servo.model.torque] != 0 and self._mode(motion) == "position"

    def _rest_of(self, mode: str) -> Writes | None:
        """Return the write that ends motion in this mode without a position; None: there is none."""
        match mode:
            case "position" | "step":
                return None
            case "velocity":
                return self.servo.speed, 0
            case "pwm" | "motor":
                return self.servo.time, 0
            case _:
                return self._torque_off

    def _why_limp(self, motion: Registers) -> str:
        if not self.target.enabled:
            return "it was limp"
        sentinel = self.servo.model.sentinel
        cause = "it has restarted" if motion[sentinel.name] == sentinel.reset else "its torque is off, and not by us"
        return f"it was limp: {cause}"

    def _why_not_held(self, mode: str) -> str:
        fit = self.servo.fit
        reason = fit.obstacle or (
            "it was not identified" if mode == UNKNOWN else f"it is in {mode}, which its model does not know"
        )
        return f"it cannot be held: {reason}"

    def _why_outside(self, present: int) -> str:
        (low, high), at = self.servo.limits or (0.0, 0.0), self.servo.calibration.to_unit(present)
        return (
            f"its torque was switched off, because it cannot be held: it is at {at:.4g}, outside its own stored limits "
            f"{low:.4g} to {high:.4g}"
        )

    def _written(self, write: Writes | None) -> Writes | None:
        if write is not None and not self.report.written:
            self.report = StopReport(self.report.action, True, self.report.confirmed, self.report.detail)
        return write

    def _report(self, action: str, *, confirmed: bool, detail: str = "") -> Writes | None:
        """Keep the report. What is not confirmed says why; nothing follows from it by itself."""
        self.report = StopReport(action, self.report.written and action != "none", confirmed, detail)
        return None
