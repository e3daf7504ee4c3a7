"""A kind of servo as data: the register map that the driver and the simulated device share.

A model is a YAML file with everything that differs between models: addresses, byte order, signs, scales, defaults, capabilities.
`Register` converts between raw integers and physical values, and refuses what the register cannot hold.
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
    """The base of everything that is read from YAML: frozen, strict, unknown keys refused. The text under a key explains it, in
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
    """Physical units per raw step."""
    unit: str = ""
    """Unit of the physical value. The servo's calibration turns `position`, `speed` and `acceleration` into its own unit."""
    minimum: int | None = None
    maximum: int | None = None
    """Raw limits of a write; None: those of the bytes."""
    default: int | None = None
    """Raw power-on (ram) or factory (eeprom) value, where the documents name one."""
    values: dict[int, int | float | str] = {}
    """Codes: raw -> physical value."""
    aliases: list[str] = []

    @property
    def end(self) -> int:
        """The address after the last byte."""
        return self.address + self.size

    @property
    def capacity(self) -> tuple[int, int]:
        """Lowest and highest raw value that the bytes can hold."""
        high = (1 << self.sign_bit) - 1 if self.sign_bit is not None else (1 << 8 * self.size) - 1
        return (-high if self.sign_bit is not None else 0, high)

    @property
    def raw_range(self) -> tuple[int, int]:
        """Lowest and highest raw value that can be written."""
        low, high = self.capacity
        return (low if self.minimum is None else self.minimum, high if self.maximum is None else self.maximum)

    def decode(self, data: bytes, byte_order: Literal["little", "big"]) -> int:
        """Return the raw signed integer in these bytes."""
        word = int.from_bytes(data, byte_order)
        if self.sign_bit is not None and word >> self.sign_bit & 1:
            return -(word & ((1 << self.sign_bit) - 1))
        return word

    def encode(self, raw: int, byte_order: Literal["little", "big"]) -> bytes:
        """Return the bytes of a raw integer. Raises LimitError outside `raw_range`."""
        low, high = self.raw_range
        if not low <= raw <= high:
            raise LimitError(f"register {self.name}: raw value {raw} is outside {low} to {high}")
        word = (1 << self.sign_bit) - raw if self.sign_bit is not None and raw < 0 else raw
        return word.to_bytes(self.size, byte_order)

    def to_physical(self, raw: int) -> int | float | str:
        """Return the physical value of a raw integer, in the register's unit."""
        if self.values:
            return self.values.get(raw, raw)
        return raw if self.scale == 1.0 else round(raw * self.scale, 9)

    def to_raw(self, value: Any) -> int:
        """Return the raw integer of a physical value. Raises LimitError for a value that this register cannot have."""
        if self.values:
            for raw, physical in self.values.items():
                if physical == value:
                    return raw
            values = ", ".join(str(physical) for physical in self.values.values())
            raise LimitError(f"register {self.name}: {value!r} is not one of {values}")
        if not is_number(value):
            raise LimitError(f"register {self.name}: {value!r} is not a finite number")
        return round(float(value) / self.scale)


class ServoModel(Data):
    """The parts that the models of every protocol have."""

    name: str
    title: str
    byte_order: Literal["little", "big"] = "little"
    registers: dict[str, Register]
    units: Annotated[dict[str, Annotated[float, Field(gt=0)]], Field(min_length=1)]
    """Unit name -> units per raw step. The first is the default."""
    zero: int = 0
    """The raw value at position 0."""
    default_speed: Annotated[float, Field(gt=0)] | None = None
    """Raw steps/s of a goal, when neither the goal nor the config names a speed."""
    status_bits: dict[Annotated[int, Field(ge=0, le=31)], str] = {}
    model_numbers: dict[int, str] = {}

    @property
    def goal_ranges(self) -> dict[str, tuple[float, float]]:
        """Lowest and highest value of each part of a goal: position (raw steps), speed (steps/s), acceleration (steps/s^2),
        torque_limit (%). (0, 0): the model does not take it. Absent: the range is not known."""
        return {}

    @model_validator(mode="before")
    @classmethod
    def _name_registers(cls, data: Any) -> Any:
        if isinstance(data, Mapping) and isinstance(data.get("registers"), Mapping):
            named = {
                name: {"name": name, **keys} if isinstance(keys, Mapping) else keys for name, keys in data["registers"].items()
            }
            return {**data, "registers": named}
        return data

    @model_validator(mode="after")
    def _names_are_unique(self) -> Self:
        owners: dict[str, str] = {}
        for register in self.registers.values():
            for name in (register.name, *register.aliases):
                if name in owners:
                    raise ValueError(f"the name {name} means both {owners[name]} and {register.name}")
                owners[name] = register.name
        return self

    @cached_property
    def by_name(self) -> dict[str, Register]:
        """Registers by name and by alias."""
        return {name: register for register in self.registers.values() for name in (register.name, *register.aliases)}

    def register(self, name: str) -> Register:
        """Return the register of a name or an alias. Raises UnknownName, which lists the names."""
        try:
            return self.by_name[name]
        except KeyError:
            names = ", ".join(sorted(self.registers))
            raise UnknownName(f"model {self.name} has no register {name!r}; it has {names}") from None

    def readable(self, name: str) -> Register:
        """Return a register that can be read. Raises UnknownName, NotSupported."""
        register = self.register(name)
        if register.access == "w":
            raise NotSupported(f"register {register.name} of model {self.name} can only be written")
        return register

    def writable(self, name: str) -> Register:
        """Return a register that can be written. Raises UnknownName, NotSupported."""
        register = self.register(name)
        if register.access == "r":
            raise NotSupported(f"register {register.name} of model {self.name} can only be read")
        return register

    def fault_names(self, status: int | None) -> tuple[str, ...]:
        """Return the names of the bits that are set in a status byte; a bit without a name is `bit N`."""
        if not status:
            return ()
        return tuple(self.status_bits.get(bit, f"bit {bit}") for bit in range(32) if status >> bit & 1)
