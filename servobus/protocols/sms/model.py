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
Mode = Literal["position", "velocity", "pwm", "step", "motor"]
"""position: to a place; velocity: at a speed; pwm and motor: by the PWM word, which is the second register of the goal; step: a
goal is a number of steps to go from here."""
LAST_ADDRESS = 255
LIMITS = ("min_angle_limit", "max_angle_limit")
"""The stored limits, the lower one first."""
SETTINGS_AT_START = ("response_status_level", *LIMITS)
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


class Family(Data):
    """Which servos have this memory table, by what they report at addresses 2 to 4."""

    end: Literal[0, 1]
    """Byte order (END, address 2): 0 little, 1 big."""
    majors: list[int] = []
    """Values of address 3 that belong to this family, whatever address 4 is."""
    products: list[Pair[int]] = []
    """Further servos of this family: values of the addresses 3 and 4."""

    def covers(self, end: int, major: int, minor: int) -> bool:
        """Return whether a servo that reports these bytes is of this family."""
        return end == self.end and (major in self.majors or (major, minor) in self.products)


class SpeedUnit(Data):
    """The bit that chooses the unit of speed."""

    name: str
    """The register that holds it."""
    bit: Annotated[int, Field(ge=0, le=7)]
    units: Pair[Annotated[float, Field(gt=0)]]
    """Steps/s of a count while the bit is 0, and while it is 1."""

    def scale(self, raw: int) -> float:
        """Return steps/s of a count, for a value of the register."""
        return self.units[raw >> self.bit & 1]


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
    family: Family
    modes: Annotated[dict[Mode, dict[str, int]], Field(min_length=1)]
    """Mode -> registers and their values in it. The first mode whose values all match is the servo's; one that matches none
    is in a mode that this model does not know, and is not moved."""
    speed_unit: SpeedUnit | None = None
    """None: the scale of the registers holds for every servo."""
    product_units: dict[int, dict[str, float]] = {}
    """Model number -> units (as `units`) of a product whose steps have another size."""
    supported: dict[str, list[int]] = {}
    """Register -> the values with which everything else of this file is true. A servo with another one is not moved."""
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
        """The kinds of goals that this model takes, each in the mode of its name."""
        kinds: tuple[GoalKind, ...] = ("position", "velocity")
        return tuple(kind for kind in kinds if kind in self.modes)

    @property
    def mode_registers(self) -> tuple[str, ...]:
        """The registers that decide about the mode."""
        return tuple(dict.fromkeys(name for registers in self.modes.values() for name in registers))

    @property
    def settings_at_start(self) -> tuple[str, ...]:
        """The registers that a servo is asked for when it is identified."""
        unit = () if self.speed_unit is None else (self.speed_unit.name,)
        return tuple(dict.fromkeys((*SETTINGS_AT_START, *self.mode_registers, *unit, *self.supported)))

    def mode(self, registers: Mapping[str, int]) -> str:
        """Return the mode of a servo whose registers have these values; "mode N" where this model does not know it."""
        for mode, values in self.modes.items():
            if all(registers[name] == value for name, value in values.items()):
                return mode
        return f"mode {', '.join(str(registers[name]) for name in self.mode_registers)}"

    def speed_scale(self, registers: Mapping[str, int]) -> float:
        """Return steps/s of a count of speed, for a servo whose registers have these values."""
        unit = self.speed_unit
        return self.registers[self.goal[2]].scale if unit is None else unit.scale(registers[unit.name])

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
        if missing := [name for name in SETTINGS_AT_START if name not in self.registers]:
            raise ValueError(f"registers: {', '.join(missing)} must be there, because every servo is asked for them")
        parts = [*self.goal, *self.feedback, *self.health, self.torque, self.lock]
        for name in [*parts, self.sentinel.name, *self.state.values(), *self.settings_at_start]:
            if name not in self.registers:
                raise ValueError(f"{name} is named as a part, but the map has no such register")
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
