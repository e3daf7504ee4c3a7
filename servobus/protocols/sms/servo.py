"""One configured FEETECH servo: its options, its model, its calibration, and the bytes that follow from them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import pairwise
from typing import Any

from servobus.errors import LimitError, NotSupported
from servobus.protocols.model import Register
from servobus.protocols.sms.model import SmsModel
from servobus.protocols.sms.options import SmsServo
from servobus.values import GoalKind, ServoGoal, Update, is_number

BY_CALIBRATION = frozenset({"position", "speed", "acceleration"})
"""Units of registers that the servo's calibration turns into its own unit."""


class FittedServo:
    """Knows how this servo says what. Holds the little that must be remembered between two frames: mode and what RAM holds."""

    def __init__(self, name: str, options: SmsServo, model: SmsModel) -> None:
        self.name = name
        self.node = options.id
        self.options = options
        self.model = model
        self.calibration = options.calibration(model)
        self.mode: GoalKind = "position"
        self.extras: dict[str, int] = {}
        """Raw acceleration and torque limit as last written; a name is absent while that is not known."""
        self.position, self.time, self.speed = (model.registers[name] for name in model.goal)
        self.decode_feedback = self._decoder(*model.feedback)
        self.decode_state = self._decoder(*model.health)

    # Registers

    def encode(self, register: Register, raw: int) -> bytes:
        try:
            return register.encode(raw, self.model.byte_order)
        except LimitError as error:
            raise error.at(servo=self.name) from None

    def decode(self, register: Register, data: bytes) -> int:
        return register.decode(data, self.model.byte_order)

    def to_physical(self, register: Register, raw: int) -> Any:
        """In the servo's unit where the register is a position, a speed or an acceleration."""
        if register.unit == "position":
            return self.calibration.to_unit(raw * register.scale)
        if register.unit == "speed":
            return self.calibration.rate_to_unit(raw * register.scale)
        if register.unit == "acceleration":
            return raw * register.scale * self.calibration.unit_per_step
        return register.to_physical(raw)

    def to_raw(self, register: Register, value: Any) -> int:
        """The inverse. Raises LimitError for what is no finite number."""
        if register.unit in BY_CALIBRATION and not is_number(value):
            raise LimitError(f"register {register.name}: {value!r} is not a finite number", servo=self.name)
        if register.unit == "position":
            return round(self.calibration.to_raw(value) / register.scale)
        if register.unit == "speed":
            return round(self.calibration.rate_to_raw(value) / register.scale)
        if register.unit == "acceleration":
            return round(float(value) / self.calibration.unit_per_step / register.scale)
        return register.to_raw(value)

    def _decoder(self, first: str, last: str) -> Callable[[bytes], Update]:
        """A function from the bytes of a block to fields of State, with everything looked up beforehand."""
        start, size = self.model.block(first, last)
        steps: list[tuple[str, int, int, Register]] = []
        for field, name in self.model.state.items():
            register = self.model.registers[name]
            if start <= register.address and register.end <= start + size:
                steps.append((field, register.address - start, register.end - start, register))

        def decode(data: bytes) -> Update:
            update: Update = {}
            for field, begin, end, register in steps:
                value = self.to_physical(register, self.decode(register, data[begin:end]))
                update[field] = bool(value) if field == "moving" else value
            return update

        return decode

    # Goals

    def goal_span(self, goal: ServoGoal) -> tuple[int, bytes]:
        """Address and bytes of a goal: position, time and speed, and acceleration before or torque limit behind them where
        this goal needs another than the servo holds. Raises LimitError, NotSupported."""
        if goal.goal.kind != self.mode:
            raise NotSupported(self._wrong_mode(goal.goal.kind), servo=self.name)
        if self.mode == "velocity":
            parts = [(self.speed, self.encode(self.speed, self._signed_speed(goal.goal.value)))]
        else:
            raw = self.calibration.to_raw(goal.goal.value)
            time, speed = self._pace(goal)
            values = zip((self.position, self.time, self.speed), (raw, time, speed), strict=True)
            parts = [(register, self.encode(register, value)) for register, value in values]
        for name, value in self.changed_extras(goal).items():
            parts.append((self.model.registers[name], self.encode(self.model.registers[name], value)))
        return self._join(parts)

    def changed_extras(self, goal: ServoGoal) -> dict[str, int]:
        """Acceleration and torque limit (raw) that this goal needs and the servo's RAM does not hold."""
        if self.mode == "velocity" and not (goal.goal.acceleration or goal.goal.effort):
            return {}  # enable() wrote them, and they do not stand beside the speed
        wanted = self.extras_for(goal.goal.acceleration, goal.goal.effort)
        return {name: raw for name, raw in wanted.items() if self.extras.get(name) != raw}

    def extras_for(self, acceleration: float | None, effort: float | None) -> dict[str, int]:
        """Raw values of the RAM registers that shape a motion, from the goal or else from the config."""
        wanted: dict[str, int] = {}
        sentinel = self.model.sentinel
        acceleration = acceleration or self.options.acceleration
        if acceleration is not None:
            register = self._extra("acceleration", "an acceleration")
            wanted["acceleration"] = max(1, self.to_raw(register, acceleration))
        elif sentinel.name == "acceleration":
            wanted["acceleration"] = sentinel.value
        effort = effort or self.options.torque_limit
        if effort is not None:
            wanted["torque_limit"] = self._extra("torque_limit", "a torque limit").to_raw(effort)
        return wanted

    def rest_time(self) -> int:
        """The time word when speed rules: 0, or the sentinel where it stands there."""
        sentinel = self.model.sentinel
        return sentinel.value if sentinel.name == self.time.name else 0

    def default_speed(self) -> int:
        """Raw speed when a goal names none: the servo's, else its greatest, else the model's."""
        wanted = self.options.speed or self.options.max_speed
        if wanted is None:
            return round((self.model.default_speed or 1.0) / self.speed.scale)
        return self._speed(wanted)

    def _pace(self, goal: ServoGoal) -> tuple[int, int]:
        """Raw time and speed words."""
        wanted = goal.goal
        if wanted.duration is not None:
            if self.model.time_is_ms:
                return max(1, round(wanted.duration * 1000)), 0
            if goal.start is None:
                raise LimitError(
                    "a duration needs the present position, and it is not known: read the servo first", servo=self.name
                )
            speed = abs(wanted.value - goal.start) / wanted.duration
            if self.options.max_speed is not None:  # it may stand farther away than it was thought to when it was asked for
                speed = min(speed, self.options.max_speed)
            return self.rest_time(), self._speed(speed) if speed else self.default_speed()
        if wanted.speed is not None:
            return self.rest_time(), self._speed(wanted.speed)
        return self.rest_time(), self.default_speed()

    def _speed(self, speed: float) -> int:
        """Raw speed of a way; 0 on the wire is no limit at all, so only `allow_max_speed` lets it through."""
        if speed == 0:
            if not self.options.allow_max_speed:
                raise LimitError("speed 0 means no limit to this servo: give a speed, or set allow_max_speed", servo=self.name)
            return 0
        return max(1, abs(round(self.calibration.rate_to_raw(speed) / self.speed.scale)))

    def _signed_speed(self, velocity: float) -> int:
        return self.to_raw(self.speed, velocity)

    def _extra(self, name: str, what: str) -> Register:
        register = self.model.registers.get(name)
        if register is None:
            raise NotSupported(f"model {self.model.name} has no register for {what}: take it out", servo=self.name)
        return register

    def _join(self, parts: Iterable[tuple[Register, bytes]]) -> tuple[int, bytes]:
        ordered = sorted(parts, key=lambda part: part[0].address)
        for (register, _), (following, _) in pairwise(ordered):
            if register.end != following.address:
                raise NotSupported(
                    f"{register.name} and {following.name} of model {self.model.name} cannot be written in one frame",
                    servo=self.name,
                )
        return ordered[0][0].address, b"".join(data for _, data in ordered)

    def _wrong_mode(self, kind: GoalKind) -> str:
        if kind not in self.model.kinds:
            return f"model {self.model.name} takes {', '.join(self.model.kinds)} goals only"
        return f"the servo is in {self.mode} mode and cannot take a {kind} goal: change its mode registers while it is disabled"
