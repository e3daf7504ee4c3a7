"""The register maps of ROH hands, which are packaged files: how many channels a register has, and how a hand tells its map.

A register is a 16-bit word, high byte first. A register of the fingers exists once for each channel, at consecutive addresses, so
one read or write carries all of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from servobus.errors import ConfigError, LimitError, NotSupported
from servobus.protocols.model import Pair, Register, ServoModel
from servobus.protocols.model_files import ModelFiles
from servobus.protocols.roh.options import CHANNELS, MAPS, Channel, RohBus, RohServo

WORD = 0x10000
FULL = 0xFFFF
"""Logical position of a closed finger."""

REQUIRED = (
    "fw_version", "sub_exception", "node_id", "status", "current_limit", "current", "speed", "pos_target", "pos", "angle_target",
    "angle",
)  # fmt: skip
"""Registers that the driver uses."""


class RohRegister(Register):
    """One register, or one for each channel."""

    size: Literal[2] = 2
    signed: bool = False
    """Two's complement."""
    channels: Annotated[int, Field(ge=0, le=10)] = 0
    """How many channels have it, from the first one on; 0: it belongs to the hand as a whole."""
    length: Annotated[int, Field(ge=1)] | list[int] = 1
    """Words of each value; a list: of each channel's value."""
    stride: Annotated[int, Field(ge=1)] = 1
    """Words from one channel to the next."""
    version: bool = False
    """High byte and low byte are separate numbers: 3.1."""
    guarded: str = ""
    """The commissioning verb that writes it; it cannot be written by name."""

    @property
    def raw_range(self) -> tuple[int, int]:
        low, high = (-WORD // 2, WORD // 2 - 1) if self.signed else (0, FULL)
        return (low if self.minimum is None else self.minimum, high if self.maximum is None else self.maximum)

    def address_of(self, channel: int) -> int:
        """Return its address for a channel. Raises NotSupported for a channel that does not have it."""
        if not self.channels:
            return self.address
        if channel >= self.channels:
            raise NotSupported(
                f"{CHANNELS[channel]} has no register {self.name}: only {', '.join(CHANNELS[: self.channels])} have"
            )
        return self.address + channel * self.stride

    def length_of(self, channel: int) -> int:
        """Return the words of its value."""
        return self.length if isinstance(self.length, int) else self.length[channel]

    def from_word(self, word: int) -> int:
        """Return the raw value in a word on the wire."""
        return word - WORD if self.signed and word >= WORD // 2 else word

    def to_word(self, raw: int) -> int:
        """Return the word on the wire. Raises LimitError outside `raw_range`."""
        low, high = self.raw_range
        if not low <= raw <= high:
            raise LimitError(f"register {self.name}: raw value {raw} is outside {low} to {high}")
        return raw % WORD

    def to_physical(self, raw: int) -> int | float | str:
        return f"{raw >> 8}.{raw & 0xFF}" if self.version else super().to_physical(raw)


class RohModel(ServoModel):
    """One register map."""

    registers: dict[str, RohRegister]  # type: ignore[assignment]  # a dict of a subclass; nothing of the base class is put in
    signature: Pair[Annotated[int, Field(ge=0, le=255)] | None]
    """High bytes of registers 1000 and 1001 that tell this map; None: any."""
    angles: dict[Channel, Pair[float]]
    """Degrees of each finger when open and when closed. The hand silently replaces a target outside by its own limit."""
    moving: list[str]
    """Status names of a finger that moves."""
    faults: list[str]
    """Status names that are faults."""
    default_current: int
    """The factory's current limit in mA, which is 100 % effort."""
    lite_gap: int | None = None
    """The LiteS001 does not have the ten registers from here on, and refuses a read across them."""
    # For the simulated device only.
    reboot_s: float = 1.0

    @property
    def goal_ranges(self) -> dict[str, tuple[float, float]]:
        """Limits of goals. Speed is missing, because its steps differ between % and degrees."""
        return {"position": (0, FULL), "acceleration": (0.0, 0.0), "torque_limit": (0.0, 100.0)}

    @model_validator(mode="after")
    def _is_complete(self) -> Self:
        missing = [name for name in REQUIRED if name not in self.registers]
        if missing or set(self.angles) != set(CHANNELS) or set(self.units) != {"%", "deg"}:
            raise ValueError(f"a map has {', '.join(REQUIRED)}, angles of each channel, and the units % and deg")
        return self

    def named(self, name: str) -> RohRegister:
        """Return a register by name or alias. Raises UnknownName, which lists the names."""
        register = self.register(name)
        assert isinstance(register, RohRegister)
        return register

    def fits(self, registers: Sequence[int]) -> bool:
        """Return whether these registers, from 1000 on, can be those of a hand with this map. None of them shows nothing."""
        matches = (high is None or word >> 8 == high for word, high in zip(registers, self.signature, strict=False))
        return bool(registers) and all(matches)

    def status_name(self, code: Any) -> str:
        return str(self.registers["status"].to_physical(code))


FILES = ModelFiles(RohModel, Path(__file__).parent / "models")
NEWEST = MAPS[-1]
"""The map that is assumed where a hand's map is not known and nothing is sent: config checks, previews, simulated hands."""


def packaged_models() -> Mapping[str, RohModel]:
    """Return the maps by name."""
    return FILES.packaged


def load_models(options: RohBus, folder: Path) -> Mapping[str, RohModel]:
    """Return all maps, because a hand's map is only known when it was asked, and `finger`, which config checks use.

    Raises ConfigError for limits in degrees that the finger cannot reach.
    """
    maps = packaged_models()
    for name, servo in options.servos.items():
        _check_angles(name, servo, maps[NEWEST])
    return {**maps, "finger": maps[NEWEST]}


def _check_angles(name: str, servo: RohServo, model: RohModel) -> None:
    if servo.unit != "deg":
        return
    calibration = servo.calibration(model)
    low, high = sorted(calibration.to_unit(angle / model.units["deg"]) for angle in model.angles[servo.channel])
    for value in (*(servo.limits or ()), servo.park_pose):
        if value is not None and not low - 1e-9 <= value <= high + 1e-9:
            raise ConfigError(f"servo {name}: {value:g} deg is outside {low:g} to {high:g}, the range of {servo.channel}")
