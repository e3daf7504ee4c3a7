"""What a KST model file says beyond the names of what can be asked: the range, and how the simulated servo behaves."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from servobus.protocols.kst.codec import Command
from servobus.protocols.model import Pair, ServoModel

Steps = Annotated[int, Field(ge=-0x8000, le=0x7FFF)]


class KstModel(ServoModel):
    """A KST servo has no memory table: a register here is a command that reads or writes one value, its address the command."""

    default_speed: Annotated[float, Field(gt=0)]
    range: Pair[Steps]
    """Least and greatest goal."""
    believed: Pair[Steps]
    """Least and greatest position that is believed."""
    # What the simulated device needs to behave like the real one.
    max_steps_per_second: Annotated[float, Field(gt=0)]
    default_position: Steps = 0
    firmware: Annotated[str, Field(pattern=r"^[ -~]{1,4}$")]
    reboot_s: Annotated[float, Field(ge=0)] = 0.5

    @property
    def goal_ranges(self) -> dict[str, tuple[float, float]]:
        """Speed is missing because the host keeps it."""
        return {"position": self.range, "acceleration": (0.0, 0.0), "torque_limit": (0.0, 0.0)}

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if "deg" not in self.units:
            raise ValueError("units: deg must be there, it is what range_deg is given in")
        if not self.believed[0] <= self.range[0] < self.range[1] <= self.believed[1]:
            raise ValueError(f"range {list(self.range)} must be ascending and inside believed {list(self.believed)}")
        for register in self.registers.values():
            if register.address not in tuple(Command):
                raise ValueError(f"registers: {register.name} has address 0x{register.address:02X}, which is no command")
        return self
