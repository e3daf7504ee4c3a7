"""One configured finger: its options, its calibration, and the words that follow from them under a given map.

Degrees and percent are two ways to say where a finger shall go, each with registers of its own; `%` is the logical position.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from servobus.errors import LimitError, NotSupported
from servobus.protocols.roh.model import FULL, RohModel, RohRegister
from servobus.protocols.roh.model_loading import channel_number
from servobus.protocols.roh.options import RohServo
from servobus.protocols.roh.spans import Span, cut
from servobus.values import ServoGoal, Update, is_number

BY_UNIT = {"%": ("pos_target", "pos"), "deg": ("angle_target", "angle")}
"""Unit of a finger -> registers of where it shall go and where it is."""
ROUNDING = {"%": 0, "deg": 100}
"""Counts by which a target may read back otherwise than it was written: the hand turns angles into positions."""
FINEST = 0.1
"""A finger arrives within about ten of these (% or degrees), however fine its registers are."""


class Finger:
    """Holds the little that must be remembered between two frames: what the hand's RAM holds, and the last status."""

    def __init__(self, name: str, options: RohServo, model: RohModel) -> None:
        """`model`: any map, for its units."""
        self.name = name
        self.node = options.id
        self.channel = channel_number(options)
        self.options = options
        self.unit = options.unit or "%"
        self.calibration = options.calibration(model)
        self.target_name, self.place_name = BY_UNIT[self.unit]
        self.enabled = False
        self.status: int | None = None
        self.targets: set[int] = set()
        """What the target register may hold; several after a write that was not answered, none while it is not known."""
        self.settings: dict[str, int] = {}
        """Speed and current limit as the hand holds them; a name is absent while that is not known."""

    def forget(self) -> None:
        """The hand has restarted, or is another one."""
        self.enabled = False
        self.status = None
        self.targets.clear()
        self.settings.clear()

    @property
    def step(self) -> float:
        return max(self.calibration.unit_per_step, FINEST)

    # Registers

    def address(self, model: RohModel, name: str) -> int:
        return model.named(name).place(self.channel)

    def to_physical(self, register: RohRegister, raw: int) -> Any:
        """In the finger's own unit where the register is a place or a target in it."""
        return self.calibration.to_unit(raw) if register.name in BY_UNIT[self.unit] else register.to_physical(raw)

    def decode(self, model: RohModel, span: Span, words: Sequence[int]) -> Update:
        """Fields of State that these words bring."""
        update: Update = {}
        for field, name in self._fields.items():
            register = model.named(name)
            address = register.place(self.channel)
            if span.holds(address):
                update[field] = self.to_physical(register, register.raw(cut(span, words, address)))
        address = self.address(model, "status")
        if span.holds(address):
            self.status = update["status"] = cut(span, words, address)
            update["moving"] = model.status_name(self.status) in model.moving
        return update

    @property
    def _fields(self) -> Mapping[str, str]:
        return {"position": self.place_name, "goal": self.target_name, "current": "current"}

    def faults(self, model: RohModel, status: int | None) -> tuple[str, ...]:
        name = model.status_name(self.status if status is None else status)
        return (name,) if name in model.faults else ()

    # Goals

    def target(self, model: RohModel, goal: ServoGoal) -> int:
        """Raw target of a goal. Raises LimitError, NotSupported."""
        wanted = goal.goal
        if wanted.kind != "position":
            raise NotSupported("a finger does positions only: give it a position", servo=self.name)
        if wanted.acceleration is not None:
            raise NotSupported("acceleration: a ROH hand has no register for it: take it out", servo=self.name)
        return self.target_at(model, wanted.value)

    def target_at(self, model: RohModel, position: float) -> int:
        """Raises LimitError for what the finger cannot reach, and would silently replace by its limit."""
        raw = self.calibration.to_raw(position)
        if self.unit == "deg":
            step = model.units["deg"]
            least, greatest = sorted(round(angle / step) for angle in model.angles[self.options.channel])
        else:
            least, greatest = 0, FULL
        if not least <= raw <= greatest:
            ends = sorted(self.calibration.to_unit(end) for end in (least, greatest))
            reach = f"what {self.options.channel} reaches: nothing was sent"
            raise LimitError(f"position {position:g} is outside {ends[0]:g} to {ends[1]:g}, {reach}", servo=self.name)
        return raw

    def wanted_settings(self, model: RohModel, goal: ServoGoal) -> dict[str, int]:
        """Raw speed and, where somebody names an effort, current limit. Raises LimitError."""
        wanted = {"speed": self._speed(model, goal)}
        effort = goal.goal.effort or self.options.torque_limit
        if effort is not None:
            wanted["current_limit"] = max(1, round(model.default_current * effort / 100))
        return wanted

    def changes(self, model: RohModel, goal: ServoGoal) -> dict[str, int]:
        """Of these, what the hand does not hold."""
        return {name: raw for name, raw in self.wanted_settings(model, goal).items() if self.settings.get(name) != raw}

    def _speed(self, model: RohModel, goal: ServoGoal) -> int:
        wanted = goal.goal.speed
        if goal.goal.duration is not None:
            if goal.start is None:
                raise LimitError(
                    "a duration needs the present position, and it is not known: read the servo first", servo=self.name
                )
            wanted = abs(goal.goal.value - goal.start) / goal.goal.duration or None
        if wanted is None:
            wanted = self.options.speed or self.options.max_speed
        if wanted is None:
            return round(model.default_speed or FULL)
        if wanted == 0:
            if not self.options.allow_max_speed:
                raise LimitError("speed 0 means no limit: give a speed, or set allow_max_speed", servo=self.name)
            return FULL
        return self._raw_speed(model, wanted)

    def _raw_speed(self, model: RohModel, speed: float) -> int:
        """Logical positions/s; degrees become positions as if both were proportional, which no document denies."""
        raw = abs(self.calibration.rate_to_raw(speed))
        if self.unit == "deg":
            open_, closed = model.angles[self.options.channel]
            raw *= model.units["deg"] * FULL / abs(closed - open_)
        if raw > FULL + 0.5:
            raise LimitError(
                f"speed {speed:g} {self.unit}/s is above the hand's greatest, {speed * FULL / raw:g}", servo=self.name
            )
        return max(1, min(FULL, round(raw)))

    # What the hand holds

    def may_hold(self, raw: int) -> None:
        """A target was sent, and nobody knows whether it was taken."""
        self.targets.add(raw)

    def holds(self, raw: int) -> None:
        """A target was taken."""
        self.targets = {raw}

    def kept(self, name: str, raw: int) -> bool:
        """Whether this is what we left in that register."""
        if name == self.target_name:
            return not self.targets or any(abs(raw - target) <= ROUNDING[self.unit] for target in self.targets)
        return self.settings.get(name, raw) == raw

    def learn(self, name: str, raw: int) -> None:
        """The hand says what it holds."""
        if name == self.target_name:
            self.holds(raw)
        else:
            self.settings[name] = raw

    def checked(self, value: object) -> int:
        """A raw value for a register. Raises LimitError."""
        if isinstance(value, bool) or not isinstance(value, int) or not is_number(value):
            raise LimitError(f"a raw value is an integer, found {value!r}", servo=self.name)
        return value
