"""What a FEETECH model file says beyond the register map: which registers play which part."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from servobus.protocols.base import GoalKind
from servobus.protocols.model import Data, Pair, Register, ServoModel


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

    # The parts below name registers of the map.
    goal: Annotated[list[str], Field(min_length=3)]
    """Position, time, speed: contiguous, in this order, written together (seed, example 4)."""
    feedback: Pair[str]
    """First and last register of the fast poll; contiguous on the wire."""
    health: Pair[str]
    """First and last register of the whole state: the health poll and read()."""
    identity: Pair[str]
    torque: str = "torque_enable"
    lock: str = "lock"
    """0: EEPROM writable, 1: locked (the seed demands the lock, the map says where)."""
    state: dict[str, str]
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
    def reach(self) -> dict[str, tuple[float, float]]:
        position, _, speed = self.goal
        names = {"position": position, "speed": speed, "acceleration": "acceleration", "torque_limit": "torque_limit"}
        return {part: self._reach_of(self.registers.get(name)) for part, name in names.items()}

    @staticmethod
    def _reach_of(register: Register | None) -> tuple[float, float]:
        least, greatest = register.span if register else (0, 0)
        return (least * register.scale, greatest * register.scale) if register else (0.0, 0.0)

    @model_validator(mode="after")
    def _parts_exist(self) -> Self:
        wheel = self.wheel.registers if self.wheel else {}
        parts = [*self.goal, *self.feedback, *self.health, *self.identity, self.torque, self.lock]
        for name in [*parts, self.sentinel.name, *self.state.values(), *wheel]:
            if name not in self.registers:
                raise ValueError(f"{name} is named as a part, but is no register of the map")
        position, time, speed = (self.registers[name] for name in self.goal)
        if not position.end == time.address or not time.end == speed.address:
            raise ValueError(f"goal: {', '.join(self.goal)} do not stand one behind the other")
        return self

    def block(self, first: str, last: str) -> tuple[int, int]:
        """Address and size of everything from one register to another."""
        start = self.registers[first].address
        return start, self.registers[last].end - start
