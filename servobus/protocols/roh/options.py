"""The YAML keys of a line of ROH hands. A hand is a unit and its fingers are servos: id is the unit, channel the finger."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator

from servobus.protocols.base import LineTraits
from servobus.protocols.modbus.codec import MAX_READ, MAX_UNIT, MAX_WRITE
from servobus.protocols.model import Data
from servobus.protocols.options import BusOptions, Name, ServoOptions

Channel = Literal["thumb_bend", "index", "middle", "ring", "little", "thumb_rotation"]
CHANNELS: tuple[Channel, ...] = ("thumb_bend", "index", "middle", "ring", "little", "thumb_rotation")
"""In the order of their numbers on the wire."""
Unit = Annotated[int, Field(ge=1, le=MAX_UNIT)]
Map = Literal["legacy", "v1", "v2"]
MAPS: tuple[Map, ...] = ("legacy", "v1", "v2")

ALWAYS_HOLDS = "a ROH hand has no torque command, and its fingers cannot be made limp: they always hold. Use hold"
DEFAULT_LIMIT = 64
"""Registers of one request; the hand's own limit is not documented."""


class RohServo(ServoOptions):
    """One finger."""

    id: Unit
    """The hand's unit, 1 to 247; a new hand has 2."""
    channel: Channel
    """The finger, or the rotation of the thumb."""
    model: Literal["finger"] = "finger"
    """Always `finger`; the hand's register map is a key of `units`."""
    unit: Literal["%", "deg"] | None = None
    """%: 0 is open, 100 is closed (the default). deg: degrees, by the angle registers."""

    @property
    def key(self) -> Hashable:
        return self.id, self.channel

    @field_validator("on_estop", "on_exit", "on_lost_client")
    @classmethod
    def _never_limp(cls, kind: str) -> str:
        if kind == "limp":
            raise ValueError(ALWAYS_HOLDS)
        return kind

    @model_validator(mode="after")
    def _has_no_acceleration(self) -> Self:
        if self.acceleration is not None:
            raise ValueError("acceleration: a ROH hand has no register for it: take it out")
        return self


class UnitOptions(Data):
    """One hand."""

    model: Literal["auto", "legacy", "v1", "v2"] = "auto"
    """Its register map. auto: the one that its first registers tell. Another value must agree with them, or nothing is
    written."""


class RohBus(BusOptions):
    protocol: Literal["roh"]
    baudrate: Annotated[int, Field(ge=300, le=10_000_000)] = 115_200
    """Baud rate of the hands, in bits/s."""
    units: dict[Unit, UnitOptions] = {}
    """Hands whose map is pinned; all others are `auto`."""
    max_read: Annotated[int, Field(ge=1, le=MAX_READ)] | None = None
    """Registers of one read; default 64, and at most what the line carries (a RealMan arm of generation 2 or 3: 12)."""
    max_write: Annotated[int, Field(ge=1, le=MAX_WRITE)] | None = None
    """Registers of one write; default 64, and at most what the line carries (such an arm: 10)."""
    single_write: Literal["multiple", "single"] = "multiple"
    """How one register is written. single (0x06): its reply looks like an echo, so it is only for lines without one."""
    turnaround_ms: Annotated[float, Field(ge=0, le=10_000)] = 100.0
    """Silence after a broadcast, in ms."""
    servos: dict[Name, RohServo] = {}
    """The servos by name; without any, the line can be scanned."""

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if self.single_write == "single" and self.echo == "auto":
            raise ValueError("single_write: single needs to know whether the line echoes: set echo to off or on")
        fingers = {servo.id for servo in self.servos.values()}
        for unit in self.units:
            if fingers and unit not in fingers:
                raise ValueError(f"units: no servo has the id {unit}; there are {', '.join(map(str, sorted(fingers)))}")
        return self

    def map_of(self, unit: int) -> str:
        return self.units[unit].model if unit in self.units else "auto"

    def limits(self, traits: LineTraits) -> tuple[int, int]:
        """Return the registers of one read and of one write on a line."""
        return _limit(self.max_read or DEFAULT_LIMIT, traits.max_read), _limit(self.max_write or DEFAULT_LIMIT, traits.max_write)


def _limit(count: int, carried: int | None) -> int:
    return count if carried is None else min(count, carried)
