"""One configured finger: its options, its calibration, and the registers that it uses in a given map.

A finger's unit is % (the logical position) or degrees, and each unit has registers of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from servobus.errors import LimitError, NotSupported
from servobus.protocols.roh.model import FULL, RohModel, RohRegister
from servobus.protocols.roh.options import CHANNELS, RohServo
from servobus.protocols.roh.spans import Span
from servobus.protocols.speed import default_speed, goal_speed
from servobus.values import Loss, ServoGoal, Update, is_number

BY_UNIT = {"%": ("pos_target", "pos"), "deg": ("angle_target", "angle")}
"""Unit of a finger -> registers of its target and of its position."""
PERCENT = FULL // 100
"""Steps by which a register may read back differently from what was written: whether a hand rounds is not documented."""
ROUNDING = {"%": PERCENT, "deg": FULL}
"""The same of a target. The hand turns angles into positions, and replaces an angle outside its own range by its limit: an angle
shows no restart."""
MIN_STEP = 0.1
"""A finger arrives within about ten of these (% or degrees), however fine its registers are."""
MAX_SPEED = FULL - 1
"""The highest speed that is written. A hand starts with FULL in RAM, so a finger whose register holds that has restarted."""


class HeldRegisters:
    """What the RAM registers of a finger hold, as the hand confirmed it. A hand that holds other values has restarted."""

    def __init__(self, target_name: str, rounding: int) -> None:
        self.targets: set[int] = set()
        """Possible values of the target register: several after a write without a reply, none while it is not known."""
        self.settings: dict[str, int] = {}
        """Speed and current limit; a name is absent while its value is not known."""
        self._target_name = target_name
        self._rounding = rounding

    def forget(self) -> None:
        """The hand has restarted, or it is another one."""
        self.targets.clear()
        self.settings.clear()

    def before_write(self, name: str, raw: int) -> None:
        """A write is about to leave. It may be applied, wholly, in part or not at all: a plan may be closed at any frame."""
        if name == self._target_name:
            self.targets.add(raw)
        else:
            self.settings.pop(name, None)

    def confirm(self, name: str, raw: int) -> None:
        """The hand has confirmed or reported this value."""
        if name == self._target_name:
            self.targets = {raw}
        else:
            self.settings[name] = raw

    def matches(self, name: str, raw: int) -> bool:
        """Return whether this reading is what the register held."""
        if name == self._target_name:
            return not self.targets or any(abs(raw - target) <= self._rounding for target in self.targets)
        return abs(self.settings.get(name, raw) - raw) <= PERCENT


class Finger:
    """Translates between a finger's unit and its registers, and keeps what the hand last reported."""

    def __init__(self, name: str, options: RohServo, model: RohModel) -> None:
        """`model`: any map, for its units."""
        self.name = name
        self.node = options.id
        self.channel = CHANNELS.index(options.channel)
        self.options = options
        self.unit = options.unit or "%"
        self.calibration = options.calibration(model)
        self.target_name, self.position_name = BY_UNIT[self.unit]
        self.status: int | None = None
        """The status code as last read."""
        self.own_current: int | None = None
        """The current limit that the finger had before a goal with an effort changed it; None: not known."""
        self.held = HeldRegisters(self.target_name, ROUNDING[self.unit])
        self._fields = {"position": self.position_name, "goal": self.target_name, "current": "current"}

    def forget(self) -> None:
        """The hand has restarted, or it is another one."""
        self.status = self.own_current = None
        self.held.forget()

    def use_options(self, options: RohServo) -> None:
        """Take options with the same channel and calibration."""
        self.options = options

    def begin(self, target: int, speed: int, current_limit: int) -> None:
        """The finger is enabled with these registers. A current limit that is not the one of our last goal is its own."""
        if self.own_current is None or current_limit != self.held.settings.get("current_limit"):
            self.own_current = current_limit
        self.held.forget()
        for name, raw in ((self.target_name, target), ("speed", speed), ("current_limit", current_limit)):
            self.held.confirm(name, raw)

    @property
    def is_begun(self) -> bool:
        """Whether it was enabled, and has neither restarted since nor been disabled."""
        return bool(self.held.targets)

    def is_kept(self, name: str, raw: int) -> bool:
        """Return whether this reading shows the register as it was left; False: the hand has restarted."""
        return self.held.matches(name, raw) and not (self.is_begun and name == "speed" and raw > MAX_SPEED)

    def near(self, raw: int, other: int, steps: float = 10.0) -> bool:
        """Return whether two positions or targets are within so many of the finger's steps, which are not those of its
        registers."""
        return abs(raw - other) <= steps * self.step / abs(self.calibration.unit_per_step)

    @property
    def step(self) -> float:
        return max(self.calibration.unit_per_step, MIN_STEP)

    # Registers

    def address(self, model: RohModel, name: str) -> int:
        return model.named(name).address_of(self.channel)

    def to_physical(self, register: RohRegister, raw: int) -> Any:
        """Return a value in the finger's own unit if the register is its target or position, else in the register's unit."""
        return self.calibration.to_unit(raw) if register.name in BY_UNIT[self.unit] else register.to_physical(raw)

    def decode(self, model: RohModel, span: Span, registers: Sequence[int]) -> Update:
        """Return the fields of State that are in these registers."""
        update: Update = {}
        for field, name in self._fields.items():
            register = model.named(name)
            address = register.address_of(self.channel)
            if span.contains(address):
                update[field] = self.to_physical(register, register.from_word(registers[address - span.start]))
        address = self.address(model, "status")
        if span.contains(address):
            self.status = update["status"] = registers[address - span.start]
            update["moving"] = model.status_name(self.status) in model.moving
        return update | self._loss(model, span, registers)

    def _loss(self, model: RohModel, span: Span, registers: Sequence[int]) -> Update:
        """Return what these registers tell about a restart: all of it only where the speed is among them."""
        if not self.is_begun:
            return {}
        kept = {}
        for name in ("speed", self.target_name):
            register = model.named(name)
            address = register.address_of(self.channel)
            if span.contains(address):
                kept[name] = self.is_kept(name, register.from_word(registers[address - span.start]))
        if not all(kept.values()):
            return {"loss": Loss.RESTARTED}
        return {"loss": None} if "speed" in kept else {}

    def faults(self, model: RohModel, status: int | None) -> tuple[str, ...]:
        name = model.status_name(self.status if status is None else status)
        return (name,) if name in model.faults else ()

    # Goals

    def target(self, model: RohModel, goal: ServoGoal) -> int:
        """Return the raw target of a goal. Raises LimitError, NotSupported."""
        if goal.goal.kind != "position":
            raise NotSupported("a finger has positions only: give it a position", servo=self.name)
        if goal.goal.acceleration is not None:
            raise NotSupported("acceleration: a ROH hand has no register for it: take it out", servo=self.name)
        return self.target_at(model, goal.goal.value)

    def target_at(self, model: RohModel, position: float) -> int:
        """Return the raw target. Raises LimitError for a position that the hand would silently replace by its limit."""
        raw = self.calibration.to_raw(position)
        if self.unit == "deg":
            low, high = sorted(round(angle / model.units["deg"]) for angle in model.angles[self.options.channel])
        else:
            low, high = 0, FULL
        if not low <= raw <= high:
            ends = sorted(self.calibration.to_unit(end) for end in (low, high))
            limits = f"{ends[0]:g} to {ends[1]:g}, the range of {self.options.channel}"
            raise LimitError(f"position {position:g} is outside {limits}: nothing was sent", servo=self.name)
        return raw

    def default_speed(self, model: RohModel) -> int:
        """Return the raw speed of a goal that names none."""
        return self._raw_speed(model, default_speed(self.options, model_speed=0.0))

    def wanted_settings(self, model: RohModel, goal: ServoGoal) -> dict[str, int]:
        """Return the raw speed and current limit: that of the goal's or the config's effort, else the finger's own.

        Raises LimitError.
        """
        settings = {"speed": self._raw_speed(model, goal_speed(goal, self.options, model_speed=0.0))}
        effort = goal.goal.effort or self.options.torque_limit
        if effort is not None:
            settings["current_limit"] = max(1, round(model.default_current * effort / 100))
        elif self.own_current is not None:
            settings["current_limit"] = self.own_current
        return settings

    def changed_settings(self, model: RohModel, goal: ServoGoal) -> dict[str, int]:
        """Return those of `wanted_settings` that the hand does not hold."""
        wanted = self.wanted_settings(model, goal)
        return {name: raw for name, raw in wanted.items() if self.held.settings.get(name) != raw}

    def _raw_speed(self, model: RohModel, speed: float) -> int:
        """Return a speed (unit/s, 0: no limit) in logical positions/s. Angles and positions count as proportional."""
        if not speed:
            return MAX_SPEED
        raw = abs(self.calibration.rate_to_raw(speed))
        if self.unit == "deg":
            open_, closed = model.angles[self.options.channel]
            raw *= model.units["deg"] * FULL / abs(closed - open_)
        if raw > FULL + 0.5:
            raise LimitError(
                f"speed {speed:g} {self.unit}/s is above the hand's maximum, {speed * FULL / raw:g}", servo=self.name
            )
        return max(1, min(MAX_SPEED, round(raw)))

    def check_raw(self, value: object) -> int:
        """Return a raw value for a register. Raises LimitError."""
        if isinstance(value, bool) or not isinstance(value, int) or not is_number(value):
            raise LimitError(f"a raw value is an integer, found {value!r}", servo=self.name)
        return value
