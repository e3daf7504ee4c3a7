"""One configured KST servo: its options, its model, its calibration, and where it can be.

The document does not say whether "read position" (KST RS422, 3.6) returns where the servo is or where it was sent. It is shown as
`position`, and nothing here depends on which it is.
"""

from __future__ import annotations

from servobus.errors import DeviceError, LimitError
from servobus.protocols.kst.codec import decode_position
from servobus.protocols.kst.model import KstModel
from servobus.protocols.kst.options import KstServo
from servobus.values import Update

JUMP_DEG = 5.0
"""How far outside its travel range a servo may be read before it must have restarted: more than load and overshoot explain."""
DECIMALS = 6
"""Decimal places of a step that count, so that 0.15 degrees are exactly between two steps, as they are written."""


class Travel:
    """Where a servo can be, in steps: between its last reading and the goals sent since.

    The protocol reports no restart. After one, the servo goes to its default position. So a servo that is read outside its travel
    range has restarted, and `jumped` stays set until it is enabled again. A restart without movement cannot be detected.
    """

    def __init__(self, jump: int) -> None:
        """`jump`: steps outside the range that a reading may have."""
        self.last: int | None = None
        """The last reading."""
        self.range: tuple[int, int] | None = None
        """None: others may move the servo too, so its readings show nothing."""
        self.jumped = False
        self.confirmed: int | None = None
        """The last goal that it confirmed."""
        self._jump = jump
        self._goals: tuple[int, ...] = ()
        """The lowest and the highest of the goals it may be travelling to: the last confirmed one, and those sent since."""

    def begin(self, raw: int) -> None:
        """The servo is here, and from now on only goals of ours move it."""
        self.last, self.range, self.jumped, self.confirmed, self._goals = raw, (raw, raw), False, None, ()

    def end(self) -> None:
        """From now on others may move it."""
        self.range, self.confirmed, self._goals = None, None, ()

    def send(self, raw: int) -> None:
        """A goal is about to leave; the servo may obey it, whether it confirms it or not."""
        if self.range is not None:
            self.range = min(self.range[0], raw), max(self.range[1], raw)
            goals = (*self._goals, raw)
            self._goals = min(goals), max(goals)

    def confirm(self, raw: int) -> None:
        """The servo has confirmed this goal, so earlier ones do not count any more."""
        if self.range is not None:
            self.confirmed, self._goals = raw, (raw,)

    def read(self, raw: int) -> None:
        """The servo was read here."""
        self.last = raw
        if self.range is not None:
            low, high = self.range
            self.jumped = self.jumped or not low - self._jump <= raw <= high + self._jump
            ends = (raw, *self._goals)
            self.range = min(ends), max(ends)


class CalibratedServo:
    """Translates between a servo's unit and the steps on the wire, and keeps what the servo last reported."""

    def __init__(self, name: str, options: KstServo, model: KstModel) -> None:
        self.name = name
        self.node = options.id
        self.options = options
        self.model = model
        self.calibration = options.calibration(model)
        degree = model.units["deg"]
        self.range = model.range if options.range_deg is None else tuple(round(end / degree) for end in options.range_deg)
        """Minimum and maximum goal, in steps."""
        self.model_speed = abs(self.calibration.rate_to_unit(model.default_speed))
        """The model's default speed, in unit/s."""
        self.status: int | None = None
        """The two status bytes as last read."""
        self.outside = False
        """The last position read was outside the range, but close enough to be accepted."""
        self.travel = Travel(round(JUMP_DEG / degree))

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

    def read_steps(self, data: bytes) -> int:
        """Return the position in a reply, in steps. Raises DeviceError for a position that this model cannot have."""
        raw = decode_position(data)
        low, high = self.model.believed
        if not low <= raw <= high:
            raise DeviceError(
                f"reads position {raw} steps, beyond {low} to {high}: garbled, or turned past its stop. Read again",
                servo=self.name,
            )
        self.outside = not self.range[0] <= raw <= self.range[1]
        self.travel.read(raw)
        return raw

    def read_position(self, data: bytes) -> float:
        """Return the position in a reply, in the servo's unit."""
        return self.to_unit(self.read_steps(data))

    def hold_steps(self, setpoint: float | None) -> int | None:
        """Return the goal (steps) that stops the servo; None: it has to be read first.

        * The servo may have restarted, or others may move it: the last reading. Its old goal would move it.
        * The setpoint is known: that, inside the travel range. Setpoints of a ramp are one step of the ramp apart, so this is
          where it is, or nearly.
        * Otherwise: the last goal that it confirmed, else the last reading. A goal that it did not confirm may be lost, so to
          send it again could move the servo.
        """
        travel = self.travel
        raw = travel.last
        if travel.range is not None and not travel.jumped:
            if setpoint is not None:
                raw = _clamp(self.calibration.to_raw(setpoint), travel.range)
            elif travel.confirmed is not None:
                raw = travel.confirmed
        return None if raw is None else _clamp(raw, self.range)

    # Fields of State

    def decode_position(self, data: bytes) -> Update:
        return {"position": self.read_position(data)}

    def decode_status(self, data: bytes) -> Update:
        self.status = int.from_bytes(data[:2], "little")
        return {"status": self.status}


def _clamp(raw: int, limits: tuple[int, ...]) -> int:
    return min(max(raw, limits[0]), limits[1])
