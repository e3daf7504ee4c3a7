"""What a YAML config may say of any bus and any servo. Each protocol adds its own keys in its own folder.

Times in seconds unless the key says `_ms`; positions in the servo's unit, speeds in unit/s.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from servobus.protocols.base import Calibration
from servobus.protocols.model import Data, Pair, ServoModel

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]
StopKind = Literal["hold", "limp", "park"]


def _finite(value: float) -> float:
    if not math.isfinite(value):
        raise ValueError("must be a finite number")
    return value


Finite = Annotated[float, AfterValidator(_finite)]
Positive = Annotated[float, Field(gt=0), AfterValidator(_finite)]
Share = Annotated[float, Field(ge=0, le=1)]
Rate = Annotated[float, Field(gt=0, le=1000)]


class FaultOptions(Data):
    """What `links/faulty.py` does to a simulated line. Shares are per frame, 0 to 1."""

    loss: Share = 0.0
    """Replies that never come."""
    chop: Literal["whole", "bytes", "random"] = "whole"
    """How replies are delivered: in one piece, byte by byte, in random pieces."""
    late: Share = 0.0
    """Replies that come `delay_ms` too late."""
    delay_ms: Annotated[float, Field(ge=0, le=10_000)] = 0.0
    duplicate: Share = 0.0
    """Replies said twice, back to back."""
    truncate: Share = 0.0
    drop_byte: Share = 0.0
    insert_byte: Share = 0.0
    flip: Share = 0.0
    """Replies with one byte changed."""
    wrong_id: Share = 0.0
    """Replies in the name of another node, checksum right."""
    noise: Share = 0.0
    """Zero bytes before a reply."""
    echo: Share = 0.0
    """Requests heard back."""
    seed: int = 0


class ServoOptions(Data):
    """One servo of any bus."""

    id: int
    model: str = ""
    zero: Finite | None = None
    direction: Literal[1, -1] = 1
    gear: Positive = 1.0
    """Turns of the servo for one turn of the joint."""
    limits: Pair[Finite] | None = None
    on_limit: Literal["reject", "clamp"] = "reject"
    speed: Positive | None = None
    max_speed: Positive | None = None
    max_step: Positive | None = None
    """Greatest distance from the last setpoint that one goal may ask for."""
    acceleration: Positive | None = None
    torque_limit: Annotated[float, Field(gt=0, le=100)] | None = None
    """Percent."""
    ttl: Positive | None = None
    on_estop: StopKind = "hold"
    on_exit: StopKind = "hold"
    on_lost_client: StopKind = "hold"
    park_pose: Finite | None = None
    park_timeout: Positive = 5.0
    unit: str | None = None
    allow_max_speed: bool = False

    @property
    def key(self) -> Hashable:
        """What no two servos of a bus share."""
        return self.id

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.limits and self.limits[0] >= self.limits[1]:
            raise ValueError(f"limits: the first must be below the second, found {list(self.limits)}")
        if "park" in (self.on_estop, self.on_exit, self.on_lost_client):
            if self.park_pose is None:
                raise ValueError("park needs a park_pose")
            if self.limits and not self.limits[0] <= self.park_pose <= self.limits[1]:
                raise ValueError(f"park_pose {self.park_pose} is outside limits {list(self.limits)}")
        if self.speed and self.max_speed and self.speed > self.max_speed:
            raise ValueError(f"speed {self.speed} is above max_speed {self.max_speed}")
        return self

    def calibration(self, model: ServoModel) -> Calibration:
        """Steps to the servo's unit. The unit must be one of the model's."""
        unit = self.unit or next(iter(model.units))
        zero = float(model.zero) if self.zero is None else self.zero
        return Calibration(zero, self.direction, model.units[unit] / self.gear)


class PollRates(Data):
    """Reads on a fixed grid, in Hz; omit for none."""

    feedback: Rate | None = None
    health: Rate | None = None

    def rates(self) -> dict[str, float]:
        return {name: hz for name, hz in (("feedback", self.feedback), ("health", self.health)) if hz}


class BusOptions(Data):
    """One bus of any protocol. `protocol` and `servos` are narrowed by each."""

    protocol: str
    port: Annotated[str, Field(min_length=1)]
    baudrate: Annotated[int, Field(ge=300, le=10_000_000)]
    poll: PollRates = PollRates()
    goal_rate: Rate | None = None
    """Hz that `check` counts goals with; the feedback rate if omitted."""
    echo: Literal["off", "on", "auto"] = "off"
    rs485: bool = False
    timeout_ms: Annotated[float, Field(gt=0, le=10_000)] | None = None
    """Greatest deadline of a turn beyond its wire time; 100 ms if omitted."""
    faults: FaultOptions | None = None
    servos: Mapping[Name, ServoOptions] = {}

    @model_validator(mode="after")
    def _faults_only_simulated(self) -> Self:
        if self.faults is not None and not self.port.startswith("sim:"):
            raise ValueError('faults are for a simulated line: set port to "sim:" or take faults out')
        return self

    @property
    def rate_of_goals(self) -> float:
        return self.goal_rate or self.poll.feedback or 50.0
