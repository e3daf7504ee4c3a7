"""One configured KST servo: its options, its model, its calibration, and where it can be.

The document does not say whether "read position" (KST RS422, 3.6) returns where the servo is or where it was sent. It is shown as
`position`, and nothing here depends on which it is.
"""

from __future__ import annotations

import math

from servobus.errors import DeviceError, LimitError
from servobus.protocols.kst.codec import decode_position
from servobus.protocols.kst.model import KstModel
from servobus.protocols.kst.options import KstServo
from servobus.values import Loss, Update

JUMP_DEG = 5.0
"""How far outside its travel range a servo may be read before it must have restarted: more than load and overshoot explain."""
JITTER_DEG = 1.0
"""How far outside its travel range one reading is believed without a second."""
MIN_LEAD_DEG = 0.5
"""A setpoint may be this far ahead of where the servo is read, however short the step of its ramp: a servo under load rests a
little off its goal, and would never begin."""
DECIMALS = 6
"""Decimal places of a step that count, so that 0.15 degrees are exactly between two steps, as they are written."""


class Travel:
    """Where a servo can be, in steps: between its last reading and the goals sent since.

    The protocol reports no restart. After one, the servo goes to its default position. So a servo that is read outside its travel
    range twice in a row has restarted, and `jumped` stays set until it is enabled again. A restart without movement cannot be
    detected. A single reading outside may be an altered reply: it is `doubted`, and nothing follows from it.
    """

    def __init__(self, jump: int, jitter: int, lead: int) -> None:
        """`jump`: steps outside the range that a reading may have; `jitter`: up to which a single one is believed."""
        self.last: int | None = None
        """The last reading that was believed."""
        self.range: tuple[int, int] | None = None
        """None: others may move the servo too, so its readings show nothing."""
        self.jumped = False
        self.doubted = False
        """The last reading was outside, and no second one has confirmed it."""
        self.confirmed: int | None = None
        """The last goal that it confirmed."""
        self.lead = lead
        """Steps that its last setpoint could be ahead of where it was read."""
        self.jitter = jitter
        self.waits = 0
        """Setpoints in a row that were not sent because it was too far behind, and no nearer than before."""
        self.verified = False
        """It was read by a verification, and not sent anything since."""
        self._behind = 0
        self._jump = jump
        self._goals: tuple[int, ...] = ()
        """The lowest and the highest of the goals it may be travelling to: the last confirmed one, and those sent since."""

    def begin(self, raw: int) -> None:
        """The servo is here, and from now on only goals of ours move it."""
        self.last, self.range, self.jumped, self.doubted, self.confirmed, self._goals = raw, (raw, raw), False, False, None, ()
        self.waits = self._behind = 0
        self.verified = False

    def end(self) -> None:
        """From now on others may move it."""
        self.range, self.confirmed, self._goals = None, None, ()

    def send(self, raw: int) -> None:
        """A goal is about to leave; the servo may obey it, whether it confirms it or not."""
        self.verified = False
        self.waits = self._behind = 0
        if self.range is not None:
            self.range = min(self.range[0], raw), max(self.range[1], raw)
            goals = (*self._goals, raw)
            self._goals = min(goals), max(goals)

    def confirm(self, raw: int) -> None:
        """The servo has confirmed this goal, so earlier ones do not count any more."""
        if self.range is not None:
            self.confirmed, self._goals = raw, (raw,)

    @property
    def held(self) -> int | None:
        """The goal that the servo holds for certain: the confirmed one, where none was sent since that may be lost."""
        return self.confirmed if self._goals == (self.confirmed,) else None

    def wait(self, behind: int) -> None:
        """Note that nothing was sent because it is so many steps behind the goal that it holds."""
        self.waits = self.waits + 1 if behind >= self._behind else 0
        self._behind = behind

    def expects(self, raw: int) -> bool:
        """Return whether a single reading is believed here."""
        return self._contains(raw, self.jitter)

    def read(self, raw: int, *, sure: bool = False) -> None:
        """The servo was read here; `sure`: by two readings that agree."""
        outside = self.range is not None and not self._contains(raw, self._jump)
        self.jumped = self.jumped or (outside and (sure or self.doubted))
        self.doubted = outside
        if outside and not self.jumped:
            return
        self.last = raw
        if self.range is not None:
            ends = (_clamp(raw, self.range), *self._goals)
            self.range = min(ends), max(ends)

    def _contains(self, raw: int, margin: int) -> bool:
        return self.range is not None and self.range[0] - margin <= raw <= self.range[1] + margin


class CalibratedServo:
    """Translates between a servo's unit and the steps on the wire, and keeps what the servo last reported."""

    def __init__(self, name: str, options: KstServo, model: KstModel) -> None:
        self.name = name
        self.node = options.id
        self.model = model
        self.calibration = options.calibration(model)
        degree = model.units["deg"]
        self.use_options(options)
        self.model_speed = abs(self.calibration.rate_to_unit(model.default_speed))
        """The model's default speed, in unit/s."""
        self.status: int | None = None
        """The two status bytes as last read."""
        self.outside = False
        """The last position read was outside the range, but close enough to be accepted."""
        jump, jitter, lead = (round(distance / degree) for distance in (JUMP_DEG, JITTER_DEG, MIN_LEAD_DEG))
        self.travel = Travel(jump, jitter, lead)
        self._min_lead = lead

    def use_options(self, options: KstServo) -> None:
        """Take options with the same id, model and calibration."""
        self.options = options
        degree = self.model.units["deg"]
        ends = options.range_deg
        self.range = self.model.range if ends is None else (round(ends[0] / degree), round(ends[1] / degree))
        """Minimum and maximum goal, in steps."""

    # Positions

    def to_raw(self, position: float) -> int:
        """Return the nearest step, ties to even. Raises LimitError outside the range, however little."""
        exact = round(self.calibration.zero + self.calibration.direction * position / self.calibration.unit_per_step, DECIMALS)
        if not self.range[0] <= exact <= self.range[1]:
            ends = sorted(self.to_unit(end) for end in self.range)
            raise LimitError(
                f"position {position:g} is outside the servo's range {ends[0]:g} to {ends[1]:g}: nothing was sent",
                servo=self.name,
            )
        return round(exact)

    def to_unit(self, raw: int) -> float:
        return round(self.calibration.to_unit(raw), 9)

    def believe(self, raw: int, *, sure: bool = False) -> int:
        """Note a reading (steps) and return it; `sure`: two readings agree.

        Raises DeviceError for a position that this model cannot have.
        """
        low, high = self.model.believed
        if not low <= raw <= high:
            raise DeviceError(
                f"reads position {raw} steps, beyond {low} to {high}: garbled, or turned past its stop. Read again",
                servo=self.name,
            )
        self.outside = not self.range[0] <= raw <= self.range[1]
        self.travel.read(raw, sure=sure)
        return raw

    def read_steps(self, data: bytes) -> int:
        """Return the position in a reply, in steps. Raises DeviceError for a position that this model cannot have."""
        return self.believe(decode_position(data))

    def read_position(self, data: bytes) -> float:
        """Return the position in a reply, in the servo's unit."""
        return self.to_unit(self.read_steps(data))

    # What is sent

    def begin_lead(self, lead: float) -> None:
        """Note how far ahead (in the servo's unit) of where it is read a setpoint may be."""
        steps = math.ceil(round(abs(lead / self.calibration.unit_per_step), DECIMALS))
        self.travel.lead = max(steps, self._min_lead)

    def ahead(self, wanted: int, present: int) -> int | None:
        """Return the setpoint (steps) on the way to the wanted one, at most one lead from where the servo was read.

        None: it lags behind a goal that it holds already. A nearer one would let a sagging joint down.
        """
        nearest = _clamp(_clamp(wanted, (present - self.travel.lead, present + self.travel.lead)), self.range)
        held = self.travel.held
        lags = held not in (None, nearest) and min(nearest, wanted) <= held <= max(nearest, wanted)
        return None if lags else nearest

    def hold_steps(self, setpoint: float | None) -> int | None:
        """Return the goal (steps) that stops the servo; None: it has to be read first.

        * The servo may have restarted, or others may move it: the last reading. Its old goal would move it.
        * The setpoint is known: that, inside the travel range. Setpoints of a ramp are one step of the ramp apart, so this is
          where it is, or nearly.
        * Otherwise: the last goal that it confirmed, else the last reading. A goal that it did not confirm may be lost, so to
          send it again could move the servo.

        It is never farther than one lead from the last reading.
        """
        travel = self.travel
        if travel.last is None:
            return None
        raw = travel.last
        if travel.range is not None and not travel.jumped:
            if setpoint is not None:
                raw = _clamp(self.calibration.to_raw(setpoint), travel.range)
            elif travel.confirmed is not None:
                raw = travel.confirmed
        return _clamp(_clamp(raw, (travel.last - travel.lead, travel.last + travel.lead)), self.range)

    # Fields of State

    def decode_position(self, data: bytes) -> Update:
        update: Update = {"position": self.read_position(data)}
        if self.travel.range is not None and (self.travel.jumped or not self.travel.doubted):
            update["loss"] = self.loss
        return update

    @property
    def loss(self) -> Loss | None:
        return Loss.RESTARTED if self.travel.jumped else None

    def decode_status(self, data: bytes) -> Update:
        self.status = int.from_bytes(data[:2], "little")
        return {"status": self.status}


def _clamp(raw: int, limits: tuple[int, int]) -> int:
    return min(max(raw, limits[0]), limits[1])
