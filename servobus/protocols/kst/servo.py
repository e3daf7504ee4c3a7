"""One configured KST servo: its options, its model, its calibration, and where it may be now.

The protocol does not tell whether read position (3.6) brings where the servo stands or where it was sent; it is shown as
`position` and nothing here depends on which it is. Nor does it tell of a restart, after which the servo goes to its default
position. What can be seen of one: the servo stands where nobody sent it.
"""

from __future__ import annotations

from servobus.errors import DeviceError, LimitError
from servobus.protocols.kst.codec import decode_position
from servobus.protocols.kst.model import KstModel
from servobus.protocols.kst.options import KstServo
from servobus.values import Update

JUMP_DEG = 5.0
"""How far off its way a servo may be before it must have restarted: more than load and overshoot explain."""
DIGITS = 6
"""Decimal places of a step that a number keeps, so that 0.15 degrees lie in the middle between two steps, as it is written."""


class FittedServo:
    """Knows how this servo says what, and remembers what of it no command can read."""

    def __init__(self, name: str, options: KstServo, model: KstModel) -> None:
        self.name = name
        self.node = options.id
        self.options = options
        self.model = model
        self.calibration = options.calibration(model)
        degree = model.units["deg"]
        self.range = model.range if options.range_deg is None else tuple(round(end / degree) for end in options.range_deg)
        """Steps it may be sent to."""
        self.setpoint: int | None = None
        """The last goal (steps) it confirmed since it was enabled."""
        self.status: int | None = None
        """The two status bytes as last read."""
        self.outside = False
        """The last position read was outside its range, though not so far that it is not believed."""
        self.jumped = False
        """It was seen where nobody sent it since it was enabled."""
        self._jump = round(JUMP_DEG / degree)
        self._last: int | None = None
        """Where it was last seen (steps)."""
        self._way: tuple[int, int] | None = None
        """While it is enabled: between which steps it may be."""

    @property
    def default_speed(self) -> float:
        """Unit/s on the way to a goal that names none."""
        default = abs(self.calibration.rate_to_unit(self.model.default_speed))
        return self.options.speed or self.options.max_speed or default

    # Positions

    def to_raw(self, position: float) -> int:
        """Nearest step, ties to even. Raises LimitError outside the range, however little."""
        exact = round(self.calibration.zero + self.calibration.direction * position / self.calibration.unit_per_step, DIGITS)
        if not self.range[0] <= exact <= self.range[1]:
            ends = sorted(self.to_unit(end) for end in self.range)
            raise LimitError(
                f"position {position:g} is outside the servo's range {ends[0]:g} to {ends[1]:g}: nothing was sent",
                servo=self.name,
            )
        return round(exact)

    def to_unit(self, raw: int) -> float:
        return round(self.calibration.to_unit(raw), 9)

    def position_of(self, data: bytes) -> int:
        """Steps in the data of a reply. Raises DeviceError for what no servo of this model can say."""
        raw = decode_position(data)
        least, greatest = self.model.believed
        if not least <= raw <= greatest:
            raise DeviceError(
                f"reads position {raw} steps, beyond {least} to {greatest}: garbled, or turned past its stop. Read again",
                servo=self.name,
            )
        self.outside = not self.range[0] <= raw <= self.range[1]
        self.seen(raw)
        return raw

    def position(self, data: bytes) -> float:
        return self.to_unit(self.position_of(data))

    # Fields of State

    def decode_position(self, data: bytes) -> Update:
        return {"position": self.position(data)}

    def decode_status(self, data: bytes) -> Update:
        self.status = int.from_bytes(data[:2], "little")
        return {"status": self.status}

    # Where it may be

    def enabled(self, raw: int) -> None:
        """It stands here, and from now on moves only where it is sent."""
        self._last, self.setpoint, self.jumped, self._way = raw, None, False, (raw, raw)

    def disabled(self) -> None:
        """From now on others may move it."""
        self._way = None

    @property
    def resting_place(self) -> int | None:
        """The goal (steps) that stops it: the last it confirmed, else where it was last seen. None: neither is known."""
        known = self._last if self.setpoint is None or self.jumped else self.setpoint
        return None if known is None else min(max(known, self.range[0]), self.range[1])

    def sent(self, raw: int) -> None:
        """A goal left for it, and may have been obeyed."""
        if self._way is not None:
            self._way = min(self._way[0], raw), max(self._way[1], raw)

    def confirmed(self, raw: int) -> None:
        self.setpoint = raw

    def seen(self, raw: int) -> None:
        """It stands here: somewhere between where it was seen before and the goals since, or it has restarted."""
        self._last = raw
        if self._way is None:
            return
        least, greatest = self._way
        if not least - self._jump <= raw <= greatest + self._jump:
            self.jumped = True
        ends = (raw, raw if self.setpoint is None else self.setpoint)
        self._way = min(ends), max(ends)
