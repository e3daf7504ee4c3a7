"""KST models: the values a servo has and its range, from the packaged file or from a file of the user's own."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, model_validator

from servobus.errors import ConfigError
from servobus.protocols.kst.codec import Command
from servobus.protocols.kst.options import KstBus, KstServo
from servobus.protocols.model import Pair, ServoModel
from servobus.protocols.model_files import ModelFiles

Steps = Annotated[int, Field(ge=-0x8000, le=0x7FFF)]


class KstModel(ServoModel):
    """A kind of KST servo. It has no memory table: a register is a command for one value, and its address is the command."""

    default_speed: Annotated[float, Field(gt=0)]
    range: Pair[Steps]
    """Minimum and maximum goal, in steps."""
    believed: Pair[Steps]
    """Minimum and maximum position that a reading may have, in steps; others are refused as garbled."""
    # For the simulated device only.
    max_steps_per_second: Annotated[float, Field(gt=0)]
    default_position: Steps = 0
    firmware: Annotated[str, Field(pattern=r"^[ -~]{1,4}$")]
    reboot_s: Annotated[float, Field(ge=0)] = 0.5

    @property
    def goal_ranges(self) -> dict[str, tuple[float, float]]:
        """Limits of goals. Speed has none, because the host keeps the speed."""
        return {"position": self.range, "acceleration": (0.0, 0.0), "torque_limit": (0.0, 0.0)}

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if "deg" not in self.units:
            raise ValueError("units: deg must be there, because range_deg is in degrees")
        if not self.believed[0] <= self.range[0] < self.range[1] <= self.believed[1]:
            raise ValueError(f"range {list(self.range)} must be ascending and inside believed {list(self.believed)}")
        for register in self.registers.values():
            if register.address not in tuple(Command):
                raise ValueError(f"registers: {register.name} has address 0x{register.address:02X}, which is not a command")
        return self


FILES = ModelFiles(KstModel, Path(__file__).parent / "models")


def packaged_model() -> KstModel:
    return FILES.packaged["kst"]


def load_models(options: KstBus, folder: Path) -> Mapping[str, KstModel]:
    """Return the models that a bus's servos name. Paths of own files start at `folder`. Raises ConfigError."""
    models: dict[str, KstModel] = {}
    for name, servo in options.servos.items():
        if servo.model not in models:
            models[servo.model] = FILES.find(servo.model, folder)
        _check_range(name, servo, models[servo.model])
    return models


def _check_range(name: str, servo: KstServo, model: KstModel) -> None:
    """Refuse a range_deg beyond the model's: a wider range needs a model file that has it."""
    if servo.range_deg is None:
        return
    lowest, highest = (end * model.units["deg"] for end in model.range)
    if servo.range_deg[0] < lowest or servo.range_deg[1] > highest:
        raise ConfigError(
            f"servo {name}: range_deg {list(servo.range_deg)} is wider than the model's {lowest:g} to {highest:g}: narrow it, or "
            "name a model file whose range is known to be wider"
        )
