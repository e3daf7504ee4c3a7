"""What a kind of servo is, as data: the register map shared by driver and simulated device.

A model is a YAML file. Everything that differs between models stands there, never in code: addresses, byte order, signs, scales,
defaults, capabilities. `Register` turns raw integers into physical values and back, and refuses what the register cannot hold.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Annotated, Any, Literal, Self, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from servobus.errors import LimitError, NotSupported, UnknownName
from servobus.values import is_number

T = TypeVar("T")
Pair = Annotated[tuple[T, T], BeforeValidator(lambda value: tuple(value) if isinstance(value, list) else value)]
"""Two values; YAML writes them as a list."""


class Data(BaseModel):
    """Frozen, strict, and deaf to unknown keys: how every model and config file is read. What stands under a key explains it in
    editors too, through the schema."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, use_attribute_docstrings=True)


class Register(Data):
    """One line of a memory table."""

    name: str = ""
    address: Annotated[int, Field(ge=0, le=0xFFFF)]
    size: Literal[1, 2, 4] = 1
    """Bytes (FEETECH) of the value."""
    access: Literal["r", "rw", "w"] = "rw"
    memory: Literal["eeprom", "ram"] = "ram"
    sign_bit: Annotated[int, Field(ge=1, le=31)] | None = None
    """Sign-magnitude with the sign in this bit; None: unsigned."""
    scale: Annotated[float, Field(gt=0)] = 1.0
    """Physical units per count."""
    unit: str = ""
    """Of the physical value. `position` and `speed` are turned into the servo's own unit by its calibration."""
    minimum: int | None = None
    maximum: int | None = None
    """Raw limits of what may be written; None: what the bytes can hold."""
    default: int | None = None
    """Raw power-on (ram) or factory (eeprom) value, where the documents name one."""
    values: dict[int, int | float | str] = {}
    """Codes that stand for other values: raw -> physical."""
    aliases: list[str] = []

    @property
    def end(self) -> int:
        """The address after the last byte."""
        return self.address + self.size

    @property
    def capacity(self) -> tuple[int, int]:
        """Least and greatest raw value that the bytes can hold."""
        greatest = (1 << self.sign_bit) - 1 if self.sign_bit is not None else (1 << 8 * self.size) - 1
        return (-greatest if self.sign_bit is not None else 0, greatest)

    @property
    def raw_range(self) -> tuple[int, int]:
        """Least and greatest raw value that can be written."""
        least, greatest = self.capacity
        return (least if self.minimum is None else self.minimum, greatest if self.maximum is None else self.maximum)

    def decode(self, data: bytes, byte_order: Literal["little", "big"]) -> int:
        """The raw signed integer in these bytes."""
        word = int.from_bytes(data, byte_order)
        if self.sign_bit is not None and word >> self.sign_bit & 1:
            return -(word & ((1 << self.sign_bit) - 1))
        return word

    def encode(self, raw: int, byte_order: Literal["little", "big"]) -> bytes:
        """The bytes of a raw integer. Raises LimitError outside `raw_range`."""
        least, greatest = self.raw_range
        if not least <= raw <= greatest:
            raise LimitError(f"register {self.name}: raw value {raw} is outside {least} to {greatest}")
        word = (1 << self.sign_bit) - raw if self.sign_bit is not None and raw < 0 else raw
        return word.to_bytes(self.size, byte_order)

    def to_physical(self, raw: int) -> int | float | str:
        if self.values:
            return self.values.get(raw, raw)
        return raw if self.scale == 1.0 else round(raw * self.scale, 9)

    def to_raw(self, value: Any) -> int:
        """The raw integer of a physical value. Raises LimitError for what is no value of this register."""
        if self.values:
            for raw, physical in self.values.items():
                if physical == value:
                    return raw
            known = ", ".join(str(physical) for physical in self.values.values())
            raise LimitError(f"register {self.name}: {value!r} is none of {known}")
        if not is_number(value):
            raise LimitError(f"register {self.name}: {value!r} is not a finite number")
        return round(float(value) / self.scale)


class ServoModel(Data):
    """What is common to the models of every protocol."""

    name: str
    title: str
    byte_order: Literal["little", "big"] = "little"
    registers: dict[str, Register]
    units: Annotated[dict[str, Annotated[float, Field(gt=0)]], Field(min_length=1)]
    """Unit name -> units per raw step. The first is the default."""
    zero: int = 0
    """The raw value at position 0."""
    default_speed: Annotated[float, Field(gt=0)] | None = None
    """Raw steps/s a goal travels at when nobody says more."""
    status_bits: dict[Annotated[int, Field(ge=0, le=31)], str] = {}
    model_numbers: dict[int, str] = {}

    @property
    def goal_ranges(self) -> dict[str, tuple[float, float]]:
        """What goals can carry, least and greatest: position (raw steps), speed (steps/s), acceleration (steps/s^2), torque_limit
        (%). Nothing: the model does not take it. Absent: not known here."""
        return {}

    @model_validator(mode="before")
    @classmethod
    def _name_registers(cls, data: Any) -> Any:
        if isinstance(data, Mapping) and isinstance(data.get("registers"), Mapping):
            named = {
                name: {"name": name, **entry} if isinstance(entry, Mapping) else entry
                for name, entry in data["registers"].items()
            }
            return {**data, "registers": named}
        return data

    @model_validator(mode="after")
    def _names_are_unique(self) -> Self:
        seen: dict[str, str] = {}
        for register in self.registers.values():
            for name in (register.name, *register.aliases):
                if name in seen:
                    raise ValueError(f"the name {name} stands for both {seen[name]} and {register.name}")
                seen[name] = register.name
        return self

    @cached_property
    def by_name(self) -> dict[str, Register]:
        """Registers by name and by alias."""
        return {name: register for register in self.registers.values() for name in (register.name, *register.aliases)}

    def register(self, name: str) -> Register:
        """Raises UnknownName and says what there is."""
        try:
            return self.by_name[name]
        except KeyError:
            known = ", ".join(sorted(self.registers))
            raise UnknownName(f"model {self.name} has no register {name!r}; it has {known}") from None

    def readable(self, name: str) -> Register:
        register = self.register(name)
        if register.access == "w":
            raise NotSupported(f"register {register.name} of model {self.name} can only be written")
        return register

    def writable(self, name: str) -> Register:
        register = self.register(name)
        if register.access == "r":
            raise NotSupported(f"register {register.name} of model {self.name} can only be read")
        return register

    def fault_names(self, status: int | None) -> tuple[str, ...]:
        """Names of the bits set in a status byte; a bit without a name is `bit N`."""
        if not status:
            return ()
        return tuple(self.status_bits.get(bit, f"bit {bit}") for bit in range(32) if status >> bit & 1)
