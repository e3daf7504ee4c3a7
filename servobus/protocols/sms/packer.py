"""Goals of one servo as bytes.

The goal block is position, time and speed (SMS 1.0, example 4), or the speed alone in velocity mode. Acceleration and torque
limit are registers beside it, so they travel in the same frame, while the servo does not hold the wanted value.
A block is packed by one `struct` that is made once for each combination of registers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import pairwise
from typing import NamedTuple

from servobus.errors import LimitError, NotSupported
from servobus.protocols.model import Register
from servobus.protocols.sms.servo import Fit, HostServo
from servobus.protocols.speed import default_speed, duration_speed, goal_speed
from servobus.values import Goal, GoalKind, ServoGoal


class PackedGoal(NamedTuple):
    """One servo's part of a goal frame, and what it was packed for."""

    servo: HostServo
    address: int
    data: bytes
    settings: Mapping[str, int]
    """Raw acceleration and torque limit that travel with it."""
    goal: Goal
    start: float | None
    fit: Fit
    held: Mapping[str, int]

    def is_for(self, goal: ServoGoal) -> bool:
        """Whether packing this goal now would give the same bytes."""
        servo = self.servo
        return (
            goal.goal is self.goal
            and self.held is servo.held
            and self.fit is servo.fit
            and (self.goal.duration is None or self.start == goal.start)
        )


class Layout(NamedTuple):
    """The registers of one goal frame."""

    address: int
    pack: Callable[..., bytes]
    before: tuple[str, ...]
    """Settings whose registers come before those of the goal."""
    after: tuple[str, ...]


class GoalPacker:
    """Packs the goals of one servo. Raises LimitError, NotSupported for goals that the servo cannot carry."""

    def __init__(self, servo: HostServo) -> None:
        self.servo = servo
        sentinel = servo.model.sentinel
        self.rest_time = sentinel.value if sentinel.name == servo.time.name else 0
        """Raw time while the speed rules: 0, or the sentinel where this register is the sentinel."""
        self._fit: Fit | None = None
        """What the servo reported when the parts below were made: they follow from its unit of speed and its limits."""
        self._usual: tuple[Layout, int, int] | None = None
        """Layout, time and speed of a plain position goal; made for the first one."""
        self._layouts: dict[tuple[str, tuple[str, ...]], Layout] = {}
        self._missing: Mapping[str, int] = {}
        """Settings that a plain goal must bring, while the servo holds `_missing_for`."""
        self._missing_for: Mapping[str, int] | None = None
        self._refit()

    def _refit(self) -> None:
        """Make what follows from what the servo reported."""
        servo = self.servo
        self._fit, self._usual, self._missing_for = servo.fit, None, None
        self.default_speed = self._default_speed()
        """Raw speed of a goal that names none."""
        self._position, self._time, self._speed = map(servo.word_maker, (servo.position, servo.time, servo.speed))

    def pack(self, goal: ServoGoal, settings: Mapping[str, int] | None = None) -> PackedGoal:
        """Return the goal as bytes, with these settings; None: with those that the servo does not hold."""
        servo, wanted = self.servo, goal.goal
        if wanted.kind != servo.takes:
            raise NotSupported(self._refusal(wanted.kind), servo=servo.name)
        if self._fit is not servo.fit:
            self._refit()
        if settings is None:
            settings = self.missing_settings(wanted)
        if settings or wanted.kind != "position" or wanted.speed is not None or wanted.duration is not None:
            address, data = self._pack_all(goal, settings)
        else:
            address, data = self._pack_position(servo.calibration.to_raw(wanted.value))
        return PackedGoal(servo, address, data, settings, wanted, goal.start, servo.fit, servo.held)

    def _pack_position(self, raw: int) -> tuple[int, bytes]:
        """Return address and bytes of a position alone, at the servo's usual speed: nearly every goal is one."""
        position = self._position(raw)
        if self._usual is None:
            self._usual = self._layout(()), self._time(self.rest_time), self._speed(self.default_speed)
        layout, time, speed = self._usual
        return layout.address, layout.pack(position, time, speed)

    def _pack_all(self, goal: ServoGoal, settings: Mapping[str, int]) -> tuple[int, bytes]:
        """Return address and bytes of any goal with these settings."""
        servo = self.servo
        layout = self._layout(tuple(settings))
        values = self._position_values(goal) if servo.fit.mode == "position" else self._velocity_values(goal.goal)
        if settings:
            before, after = (self._setting_values(names, settings) for names in (layout.before, layout.after))
            values = (*before, *values, *after)
        return layout.address, layout.pack(*values)

    def first_goal(self, present: int) -> tuple[int, bytes]:
        """Return address and bytes of the goal that enable() writes: the present raw position, or speed 0 in velocity mode."""
        if self._fit is not self.servo.fit:
            self._refit()
        if self.servo.fit.mode == "position":
            return self._pack_position(present)
        layout = self._layout(())
        return layout.address, layout.pack(0)

    # Settings beside the goal

    def missing_settings(self, goal: Goal) -> Mapping[str, int]:
        """Return the settings (raw) that this goal needs and the servo does not hold."""
        held = self.servo.held
        if goal.acceleration is not None or goal.effort is not None:
            return _missing(self.settings(goal.acceleration, goal.effort), held)
        if self._missing_for is not held:
            settings = self.settings(None, None)
            if self.servo.fit.mode == "velocity":
                settings.pop("acceleration", None)  # enable() wrote it, and it is not beside the speed
            self._missing, self._missing_for = _missing(settings, held), held
        return self._missing

    def settings(self, acceleration: float | None, effort: float | None) -> dict[str, int]:
        """Return the raw acceleration and torque limit of a motion: the goal's, else the config's, else the servo's own.

        An acceleration that is the sentinel always has a value, so that a restart shows.
        """
        servo, sentinel = self.servo, self.servo.model.sentinel
        settings = {sentinel.name: sentinel.value} if sentinel.name == "acceleration" else {}
        settings |= servo.own
        acceleration = acceleration or servo.options.acceleration
        if acceleration is not None:
            register = self._setting("acceleration", "an acceleration")
            settings["acceleration"] = max(1, servo.to_raw(register, acceleration))  # 0 means no limit
        effort = effort or servo.options.torque_limit
        if effort is not None:
            settings["torque_limit"] = self._setting("torque_limit", "a torque limit").to_raw(effort)
        return settings

    def _setting(self, name: str, meaning: str) -> Register:
        register = self.servo.model.registers.get(name)
        if register is None:
            text = f"model {self.servo.model.name} has no register for {meaning}: take it out"
            raise NotSupported(text, servo=self.servo.name)
        return register

    def _setting_values(self, names: tuple[str, ...], settings: Mapping[str, int]) -> list[int]:
        registers = self.servo.model.registers
        return [self.servo.word_maker(registers[name])(settings[name]) for name in names]

    # Values of the goal registers

    def _position_values(self, goal: ServoGoal) -> tuple[int, ...]:
        position = self._position(self.servo.calibration.to_raw(goal.goal.value))
        time, speed = self._time_and_speed(goal)
        return position, self._time(time), self._speed(speed)

    def _velocity_values(self, goal: Goal) -> tuple[int, ...]:
        raw = self.servo.to_raw(self.servo.speed, goal.value)
        if not raw and goal.value:
            raise self._too_slow("velocity", goal.value)
        return (self._speed(raw),)

    def _time_and_speed(self, goal: ServoGoal) -> tuple[int, int]:
        """Raw time and speed of a position goal: the time rules only where the model has one and a duration is given."""
        duration = goal.goal.duration
        if duration is not None:
            if self.servo.model.time_is_ms:
                return max(1, round(duration * 1000)), 0
            speed = duration_speed(goal, self.servo.options)
            return self.rest_time, self._raw_speed(speed) if speed else self.default_speed
        if goal.goal.speed is None:
            return self.rest_time, self.default_speed
        speed = goal_speed(goal, self.servo.options, 0.0)
        is_coarse = (self.servo.fit.speed_scale or 1) > 1  # one step/s too much is none
        if speed and is_coarse and not self.servo.to_raw(self.servo.speed, speed):
            raise self._too_slow("speed", speed)
        return self.rest_time, self._raw_speed(speed) if speed else 0

    def _too_slow(self, what: str, value: float) -> LimitError:
        slowest = abs(self.servo.to_physical(self.servo.speed, 1))
        return LimitError(
            f"{what} {value:g} is slower than the servo can be told: its slowest is {slowest:.3g}; nothing was sent",
            servo=self.servo.name,
        )

    def _raw_speed(self, speed: float) -> int:
        """At least 1, because 0 means no limit on the wire."""
        return max(1, abs(self.servo.to_raw(self.servo.speed, speed)))

    def _default_speed(self) -> int:
        speed = default_speed(self.servo.options, 0.0)
        if not speed:
            speed = self.servo.calibration.rate_to_unit(self.servo.model.default_speed or 1.0)
        return self._raw_speed(speed)

    # Layouts

    def _layout(self, settings: tuple[str, ...]) -> Layout:
        key = (self.servo.fit.mode, settings)
        return self._layouts.get(key) or self._new_layout(*key)

    def _new_layout(self, mode: str, settings: tuple[str, ...]) -> Layout:
        """Make the layout of a goal with these settings. Raises NotSupported where the registers do not follow one another."""
        servo = self.servo
        goal = [servo.speed] if mode == "velocity" else [servo.position, servo.time, servo.speed]
        beside = [servo.model.registers[name] for name in settings]
        registers = sorted([*goal, *beside], key=lambda register: register.address)
        for register, following in pairwise(registers):
            if register.end != following.address:
                raise NotSupported(
                    f"{register.name} and {following.name} of model {servo.model.name} cannot be written in one frame",
                    servo=servo.name,
                )
        at = registers.index(goal[0])
        before, after = registers[:at], registers[at + len(goal) :]
        names = (tuple(register.name for register in part) for part in (before, after))
        layout = Layout(registers[0].address, servo.packer(registers), *names)
        self._layouts[mode, settings] = layout
        return layout

    def _refusal(self, kind: GoalKind) -> str:
        model, fit = self.servo.model, self.servo.fit
        if fit.obstacle:
            return fit.obstacle
        if kind not in model.kinds:
            return f"model {model.name} takes {', '.join(model.kinds)} goals only"
        return f"the servo is in {fit.mode} mode and cannot take a {kind} goal: change its mode registers while it is disabled"


def _missing(settings: Mapping[str, int], held: Mapping[str, int]) -> dict[str, int]:
    return {name: raw for name, raw in settings.items() if held.get(name) != raw}
