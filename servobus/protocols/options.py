"""The YAML keys of every bus and of every servo. Each protocol adds its own keys in its own package.

Times in seconds unless the key says `_ms`; positions in the servo's unit, speeds in unit/s.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping
from typing import Annotated, ClassVar, Literal, Self, cast

from pydantic import AfterValidator, Field, model_validator

from servobus.protocols.model import Data, Pair, ServoModel
from servobus.values import Calibration

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
    """The faults of a simulated line (`links/faulty.py`). Shares are per frame, 0 to 1."""

    loss: Share = 0.0
    """Share of replies that are lost."""
    chop: Literal["whole", "bytes", "random"] = "whole"
    """How replies are delivered: in one piece, byte by byte, or in random pieces."""
    late: Share = 0.0
    """Share of replies that come `delay_ms` too late."""
    delay_ms: Annotated[float, Field(ge=0, le=10_000)] = 0.0
    """Delay of a late reply, in ms."""
    duplicate: Share = 0.0
    """Share of replies that are sent twice, back to back."""
    truncate: Share = 0.0
    """Share of replies that end too early."""
    drop_byte: Share = 0.0
    """Share of replies with one byte missing."""
    insert_byte: Share = 0.0
    """Share of replies with one byte more."""
    flip: Share = 0.0
    """Share of replies with one byte changed."""
    wrong_id: Share = 0.0
    """Share of replies with the id of another node and a right checksum."""
    noise: Share = 0.0
    """Share of replies with zero bytes before them."""
    echo: Share = 0.0
    """Share of requests that come back as an echo."""
    seed: int = 0
    """Seed of the random numbers: the same seed gives the same faults."""


class ServoOptions(Data):
    """One servo of any bus."""

    live: ClassVar[frozenset[str]] = frozenset(
        {"limits", "on_limit", "speed", "max_speed", "max_step", "acceleration", "torque_limit", "ttl", "allow_max_speed"}
        | {"on_estop", "on_exit", "on_lost_client", "park_pose", "park_timeout"}
    )
    """Keys that a running bus takes when the config is read again."""

    id: int
    """Id of the servo's node on the line."""
    model: str = ""
    """Model of the servo: a name, or the path of a model file of your own."""
    zero: Annotated[float, Field(ge=-1e9, le=1e9)] | None = None
    """Raw position of the servo where the joint is at 0, in steps; the model's middle if omitted."""
    direction: Literal[1, -1] = 1
    """Sign of the joint's position: -1 where the servo is mounted the other way round."""
    gear: Annotated[float, Field(ge=0.001, le=1000)] = 1.0
    """Turns of the servo for one turn of the joint."""
    limits: Pair[Finite] | None = None
    """Lowest and highest position that a goal may have, in the servo's unit."""
    on_limit: Literal["reject", "clamp"] = "reject"
    """What happens to a goal outside a limit: it is refused, or the nearest value inside is sent and an event reports that."""
    speed: Positive | None = None
    """Speed of goals that name none, in unit/s; max_speed if omitted."""
    max_speed: Positive | None = None
    """Highest speed that a goal may have, in unit/s; the model's own if omitted."""
    max_step: Positive | None = None
    """Longest distance of a goal from the last setpoint, in the servo's unit; no limit if omitted."""
    acceleration: Positive | None = None
    """Acceleration of goals that name none, in unit/s^2; the servo's own setting if omitted."""
    torque_limit: Annotated[float, Field(gt=0, le=100)] | None = None
    """Effort of goals that name none, in percent of the servo's torque; the servo's own setting if omitted."""
    ttl: Positive | None = None
    """Time in s within which a goal's first byte must leave; the larger of 0.2 s and two turns if omitted."""
    on_estop: StopKind = "hold"
    """What an e-stop does: hold keeps the present position, limp switches torque off, park goes to park_pose and then limp."""
    on_exit: StopKind = "hold"
    """What servobus does to an enabled servo when it ends: hold, limp or park."""
    on_lost_client: StopKind = "hold"
    """What happens when the program that moved the servo is gone: hold, limp or park."""
    park_pose: Finite | None = None
    """Position that park goes to, in the servo's unit."""
    park_timeout: Positive = 5.0
    """Time in s to reach park_pose; then the servo goes limp, wherever it is."""
    unit: str | None = None
    """Unit of positions and speeds: one of the model's units, the first of them if omitted."""
    allow_max_speed: bool = False
    """Whether a goal may have the speed 0, which servos take as no limit."""

    @property
    def key(self) -> Hashable:
        """What no two servos of a bus may have in common."""
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
        """Return the conversion from raw steps to the servo's unit, which must be one of the model's."""
        unit = self.unit or next(iter(model.units))
        zero = float(model.zero) if self.zero is None else self.zero
        return Calibration(zero, self.direction, model.units[unit] / self.gear)


class PollRates(Data):
    """Reads on a fixed grid, in Hz; omit for none."""

    feedback: Rate | None = None
    """Rate in Hz of the values that control needs: position, speed, load and the registers beside them."""
    health: Rate | None = None
    """Rate in Hz of the whole state."""

    def rates(self) -> dict[str, float]:
        return {name: hz for name, hz in (("feedback", self.feedback), ("health", self.health)) if hz}


class BusOptions(Data):
    """One bus of any protocol. `protocol` and `servos` are narrowed by each."""

    live: ClassVar[frozenset[str]] = frozenset({"poll", "goal_rate"})
    """Keys that a running bus takes when the config is read again, beside those of its servos."""

    protocol: str
    """Protocol of the servos on the line."""
    port: Annotated[str, Field(min_length=1, max_length=255)]
    """Device file, tcp://HOST:PORT, realman://HOST:PORT?port=N, or sim: for simulated servos. A /dev/serial/by-id name is best,
    because it belongs to the adapter."""
    baudrate: Annotated[int, Field(ge=300, le=10_000_000)]
    """Baud rate of the servos, in bits/s."""
    poll: PollRates = PollRates()
    """Rates at which the servos are read."""
    goal_rate: Rate | None = None
    """Rate in Hz at which goals are expected: `check` computes the line's load with it. The feedback rate if omitted."""
    echo: Literal["off", "on", "auto"] = "off"
    """Whether the adapter receives what it sends; auto finds out with a request to an id that nobody has."""
    rs485: bool = False
    """Let the driver of the port switch the transmitter; USB adapters switch it by themselves."""
    timeout_ms: Annotated[float, Field(gt=0, le=10_000)] | None = None
    """Longest wait in ms for a reply beyond its wire time; 100 if omitted."""
    faults: FaultOptions | None = None
    """Faults of a simulated line."""
    servos: Mapping[Name, ServoOptions] = {}
    """The servos by name; without any, the line can be scanned."""

    @model_validator(mode="after")
    def _faults_only_simulated(self) -> Self:
        if self.faults is not None and not self.port.startswith("sim:"):
            raise ValueError('faults are for a simulated line: set port to "sim:" or take faults out')
        return self

    @property
    def spread(self) -> float | None:
        """On four wires: seconds by which the pauses before the replies of two servos may differ. None: half duplex."""
        return None

    def is_live_change(self, other: BusOptions) -> bool:
        """Return whether a running bus with these options can take the others: only rates, limits, speeds and policies differ."""
        servos, others = _servos_of(self), _servos_of(other)
        return (
            _fixed(self) == _fixed(other)
            and servos.keys() == others.keys()
            and all(_fixed(servo) == _fixed(others[name]) for name, servo in servos.items())
        )

    @property
    def rate_of_goals(self) -> float:
        return self.goal_rate or self.poll.feedback or 50.0


def _fixed(options: ServoOptions | BusOptions) -> tuple[type, dict[str, object]]:
    """Return the keys that need the bus to be opened again."""
    return type(options), options.model_dump(exclude={*options.live, "servos"})


def _servos_of(options: BusOptions) -> Mapping[str, ServoOptions]:
    return cast("Mapping[str, ServoOptions]", vars(options)["servos"])  # each protocol narrows it to its own class
