"""What a FEETECH model file says beyond the register map: which registers play which part."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from servobus.protocols.model import Data, Pair, Register, ServoModel
from servobus.values import GoalKind

StateField = Literal["position", "goal", "speed", "load", "current", "voltage", "temperature", "moving", "status"]
LAST_ADDRESS = 255
ASKED = ("response_status_level", "min_angle_limit", "max_angle_limit")
"""Registers that every servo is asked for at start, by these names."""


def _fits_the_table(register: Register) -> Register:
    """What a memory table cannot hold is found when the file is read, not when a servo moves."""
    if register.end > LAST_ADDRESS + 1:
        raise ValueError(f"found {register.size} bytes at address {register.address}; the last address is {LAST_ADDRESS}")
    bits = 8 * register.size
    if register.sign_bit is not None and register.sign_bit >= bits:
        raise ValueError(f"found sign_bit {register.sign_bit}; its {register.size} bytes have bits 0 to {bits - 1}")
    (least, greatest), (low, high) = register.capacity, register.raw_range
    if not least <= low <= high <= greatest:
        raise ValueError(f"found values {low} to {high}; it can hold {least} to {greatest}")
    if register.default is not None and not least <= register.default <= greatest:
        raise ValueError(f"found default {register.default}; it can hold {least} to {greatest}")
    return register


class Sentinel(Data):
    """A RAM register that enable() sets and that a restart puts back to `reset`: how a restart is noticed."""

    name: str
    value: int
    reset: int


class Wheel(Data):
    """How a servo is seen to be in wheel mode: this register reads this value (a list: all of them)."""

    registers: dict[str, int]


class SmsModel(ServoModel):
    """One FEETECH family. Register parts are named, so that the driver holds no address."""

    registers: dict[str, Annotated[Register, AfterValidator(_fits_the_table)]]
    # The parts below name registers of the map.
    goal: Annotated[list[str], Field(min_length=3, max_length=3)]
    """Position, time, speed: contiguous, in this order, written together (seed, example 4)."""
    feedback: Pair[str]
    """First and last register of the fast poll; contiguous on the wire."""
    health: Pair[str]
    """First and last register of the whole state: the health poll and read()."""
    torque: str = "torque_enable"
    lock: str = "lock"
    """0: EEPROM writable, 1: locked (the seed demands the lock, the map says where)."""
    state: dict[StateField, str]
    """Field of State -> register."""
    sentinel: Sentinel
    wheel: Wheel | None = None
    """None: position only."""
    time_is_ms: bool = False
    """The time word is milliseconds for the way, used when speed is 0 (SCS); else it stays 0."""
    sync_read: bool = False
    """Answers SYNC READ 0x82, which the seed does not know."""
    # What the simulated device needs to behave like the real one.
    steps_per_turn: Annotated[int, Field(gt=0)]
    model_number: int
    """What the simulated device says at identity."""
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
        least, greatest = register.raw_range if register else (0, 0)
        return (least * register.scale, greatest * register.scale) if register else (0.0, 0.0)

    @model_validator(mode="after")
    def _parts_exist(self) -> Self:
        wheel = self.wheel.registers if self.wheel else {}
        parts = [*self.goal, *self.feedback, *self.health, self.torque, self.lock]
        for name in [*parts, self.sentinel.name, *self.state.values(), *wheel]:
            if name not in self.registers:
                raise ValueError(f"{name} is named as a part, but is no register of the map")
        if missing := [name for name in ASKED if name not in self.registers]:
            raise ValueError(f"registers: {', '.join(missing)} must be there, every servo is asked for them at start")
        if "position" not in self.state:
            raise ValueError("state: position must be there, enable and hold begin from it")
        position, time, speed = (self.registers[name] for name in self.goal)
        if not position.end == time.address or not time.end == speed.address:
            raise ValueError(f"goal: {', '.join(self.goal)} do not stand one behind the other")
        for first, last in (self.feedback, self.health):
            if self.block(first, last)[1] <= 0:
                raise ValueError(f"{first} stands behind {last}: name the first register of the block first")
        return self

    def block(self, first: str, last: str) -> tuple[int, int]:
        """Address and size of everything from one register to another."""
        start = self.registers[first].address
        return start, self.registers[last].end - start
