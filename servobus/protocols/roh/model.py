"""What a map of the ROH hand says beyond names and addresses: how many channels a register has, and how a hand tells its map.

All numbers of a hand are words of 16 bits, high byte first. A register of the fingers stands once for each channel, one behind
the other, so one read or write carries all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from servobus.errors import LimitError, NotSupported
from servobus.protocols.model import Pair, Register, ServoModel

WORD = 0x10000
FULL = 0xFFFF
"""Logical position of a closed finger."""

Channel = Literal["thumb_bend", "index", "middle", "ring", "little", "thumb_rotation"]
CHANNELS: tuple[Channel, ...] = ("thumb_bend", "index", "middle", "ring", "little", "thumb_rotation")
"""Place in this row = number on the timing."""

PARTS = (
    "fw_version", "sub_exception", "node_id", "status", "current_limit", "current", "speed", "pos_target", "pos", "angle_target",
    "angle",
)  # fmt: skip
"""Registers the driver counts on."""


class RohRegister(Register):
    """One register, or one for each channel."""

    size: Literal[2] = 2
    signed: bool = False
    """Two's complement."""
    channels: Annotated[int, Field(ge=0, le=10)] = 0
    """0: of the hand as a whole; else the channels that have it, from the first on."""
    words: Annotated[int, Field(ge=1)] | list[int] = 1
    """Words of each value; a list: of each channel."""
    stride: Annotated[int, Field(ge=1)] = 1
    """Words from one channel to the next."""
    version: bool = False
    """High byte and low byte are told apart: 3.1."""
    guarded: str = ""
    """Never written by name: the commissioning verb that does it."""

    @property
    def raw_range(self) -> tuple[int, int]:
        least, greatest = (-WORD // 2, WORD // 2 - 1) if self.signed else (0, FULL)
        return (least if self.minimum is None else self.minimum, greatest if self.maximum is None else self.maximum)

    def place(self, channel: int) -> int:
        """Its address. Raises NotSupported for a channel that has none."""
        if not self.channels:
            return self.address
        if channel >= self.channels:
            raise NotSupported(
                f"{CHANNELS[channel]} has no register {self.name}: only {', '.join(CHANNELS[: self.channels])} have"
            )
        return self.address + channel * self.stride

    def length(self, channel: int) -> int:
        """Words of its value."""
        return self.words if isinstance(self.words, int) else self.words[channel]

    def raw(self, word: int) -> int:
        return word - WORD if self.signed and word >= WORD // 2 else word

    def word(self, raw: int) -> int:
        """Raises LimitError outside `raw_range`."""
        least, greatest = self.raw_range
        if not least <= raw <= greatest:
            raise LimitError(f"register {self.name}: raw value {raw} is outside {least} to {greatest}")
        return raw % WORD

    def to_physical(self, raw: int) -> int | float | str:
        return f"{raw >> 8}.{raw & 0xFF}" if self.version else super().to_physical(raw)


class RohModel(ServoModel):
    """One register map."""

    registers: dict[str, RohRegister]  # type: ignore[assignment]  # a dict of subclasses is no dict of the base, and none is put in
    signature: Pair[Annotated[int, Field(ge=0, le=255)] | None]
    """High bytes of registers 1000 and 1001 that tell this map; None: any."""
    angles: dict[Channel, Pair[float]]
    """Degrees of each open and each closed finger. What is outside the hand would silently replace by its own limit."""
    moving: list[str]
    """Status names of a finger that moves."""
    faults: list[str]
    """Status names that are faults."""
    default_current: int
    """Milliampere of 100 % effort: the factory's current limit."""
    # What the simulated device needs to behave like the real one.
    reboot_s: float = 1.0

    @property
    def goal_ranges(self) -> dict[str, tuple[float, float]]:
        """Speed is missing, for its steps are other ones in degrees."""
        return {"position": (0, FULL), "acceleration": (0.0, 0.0), "torque_limit": (0.0, 100.0)}

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        missing = [name for name in PARTS if name not in self.registers]
        if missing or set(self.angles) != set(CHANNELS) or set(self.units) != {"%", "deg"}:
            raise ValueError(f"a map has {', '.join(PARTS)}, angles of each channel, and the units % and deg")
        return self

    def named(self, name: str) -> RohRegister:
        """By name or alias. Raises UnknownName and says what there is."""
        found = self.register(name)
        assert isinstance(found, RohRegister)
        return found

    def fits(self, heard: Sequence[int]) -> bool:
        """Whether a hand whose registers from 1000 on begin so has this map."""
        return all(high is None or word >> 8 == high for word, high in zip(heard, self.signature, strict=False))

    def status_name(self, code: Any) -> str:
        return str(self.registers["status"].to_physical(code))
