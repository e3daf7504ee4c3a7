"""FEETECH models: the register map and the part that each register plays, read from model files.

The packaged models are in `models/`; a config may name a model file of its own, which may extend a packaged one.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from servobus.protocols.model import Data, Pair, Register, ServoModel
from servobus.protocols.model_files import ModelFiles
from servobus.protocols.sms.options import SmsBus
from servobus.values import GoalKind

StateField = Literal["position", "goal", "speed", "load", "current", "voltage", "temperature", "moving", "status"]
LAST_ADDRESS = 255
SETTINGS_AT_START = ("response_status_level", "min_angle_limit", "max_angle_limit")
"""Registers that every servo is asked for when it is identified; every model must have them."""


def _fits_the_table(register: Register) -> Register:
    """Refuse a register that its bytes or the memory table cannot hold, when the file is read instead of when a servo moves."""
    if register.end > LAST_ADDRESS + 1:
        raise ValueError(f"found {register.size} bytes at address {register.address}; the last address is {LAST_ADDRESS}")
    bits = 8 * register.size
    if register.sign_bit is not None and register.sign_bit >= bits:
        raise ValueError(f"found sign_bit {register.sign_bit}; its {register.size} bytes have bits 0 to {bits - 1}")
    (lowest, highest), (low, high) = register.capacity, register.raw_range
    if not lowest <= low <= high <= highest:
        raise ValueError(f"found values {low} to {high}; it can hold {lowest} to {highest}")
    if register.default is not None and not lowest <= register.default <= highest:
        raise ValueError(f"found default {register.default}; it can hold {lowest} to {highest}")
    return register


class Sentinel(Data):
    """A RAM register that enable() sets to `value` and that a restart puts back to `reset`, so that the restart is noticed."""

    name: str
    value: int
    reset: int


class Wheel(Data):
    """How wheel mode is recognised."""

    registers: dict[str, int]
    """Register -> its value in wheel mode; all of them must match."""


class SmsModel(ServoModel):
    """One FEETECH family. The file names the register of each part, so the driver contains no address."""

    registers: dict[str, Annotated[Register, AfterValidator(_fits_the_table)]]
    # The parts below name registers of the map.
    goal: Annotated[list[str], Field(min_length=3, max_length=3)]
    """Position, time, speed: contiguous, in this order, written together (SMS 1.0, example 4)."""
    feedback: Pair[str]
    """First and last register of the fast poll; contiguous on the wire."""
    health: Pair[str]
    """First and last register of the whole state: the health poll and read()."""
    torque: str = "torque_enable"
    lock: str = "lock"
    """0: EEPROM can be written, 1: it is locked (SMS 1.0, 1.3.3)."""
    state: dict[StateField, str]
    """Field of State -> register."""
    sentinel: Sentinel
    wheel: Wheel | None = None
    """None: position only."""
    time_is_ms: bool = False
    """The time register is the duration of the motion in milliseconds, used when speed is 0 (SCS); else it remains 0."""
    sync_read: bool = False
    """Answers SYNC READ (0x82), which is newer than SMS 1.0."""
    # The simulated device needs these to behave like the real one.
    steps_per_turn: Annotated[int, Field(gt=0)]
    model_number: int
    """What a simulated servo reports."""
    max_steps_per_second: Annotated[float, Field(gt=0)]
    reboot_s: float = 0.8

    @property
    def kinds(self) -> tuple[GoalKind, ...]:
        return ("position", "velocity") if self.wheel else ("position",)

    @property
    def goal_ranges(self) -> dict[str, tuple[float, float]]:
        position, _, speed = self.goal
        names = {"position": position, "speed": speed, "acceleration": "acceleration", "torque_limit": "torque_limit"}
        return {part: self._goal_range(self.registers.get(name)) for part, name in names.items()}

    @staticmethod
    def _goal_range(register: Register | None) -> tuple[float, float]:
        if register is None:
            return (0.0, 0.0)
        low, high = register.raw_range
        return (low * register.scale, high * register.scale)

    @model_validator(mode="after")
    def _parts_exist(self) -> Self:
        wheel = self.wheel.registers if self.wheel else {}
        parts = [*self.goal, *self.feedback, *self.health, self.torque, self.lock]
        for name in [*parts, self.sentinel.name, *self.state.values(), *wheel]:
            if name not in self.registers:
                raise ValueError(f"{name} is named as a part, but the map has no such register")
        if missing := [name for name in SETTINGS_AT_START if name not in self.registers]:
            raise ValueError(f"registers: {', '.join(missing)} must be there, because every servo is asked for them")
        if "position" not in self.state:
            raise ValueError("state: position must be there, because enable and hold begin from it")
        position, time, speed = (self.registers[name] for name in self.goal)
        if not position.end == time.address or not time.end == speed.address:
            raise ValueError(f"goal: {', '.join(self.goal)} do not follow one another")
        for first, last in (self.feedback, self.health):
            if self.block(first, last)[1] <= 0:
                raise ValueError(f"{first} comes after {last}: name the first register of the block first")
        return self

    def block(self, first: str, last: str) -> tuple[int, int]:
        """Address and size of everything from one register to another."""
        start = self.registers[first].address
        return start, self.registers[last].end - start


FILES = ModelFiles(SmsModel, Path(__file__).parent / "models")


def packaged_models() -> Mapping[str, SmsModel]:
    """Return the models of this package by name."""
    return FILES.packaged


def load_models(options: SmsBus, folder: Path) -> Mapping[str, SmsModel]:
    """Return the models that a bus's servos name; files of the user's own are looked for in `folder`. Raises ConfigError."""
    return FILES.load((servo.model for servo in options.servos.values()), folder)
