"""The host's half of one configured FEETECH servo: its units, what it reported, and the meaning of its blocks of registers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from struct import Struct
from typing import Any

from servobus.errors import LimitError
from servobus.protocols.model import Register
from servobus.protocols.sms.model import SmsModel
from servobus.protocols.sms.options import SmsServo
from servobus.protocols.sms.requests import Read, RegisterRead
from servobus.values import GoalKind, Update, is_number

STRUCT_CODES = {1: "B", 2: "H", 4: "I"}
"""Bytes of a register -> its code for `struct`; signs are sign and magnitude, so every register is unsigned on the wire."""
Fields = list[tuple[str, Register]]
"""Field of State, register that holds it."""
CALIBRATED_UNITS = frozenset({"position", "speed", "acceleration"})
"""Units of registers that the servo's calibration turns into its own unit."""


@dataclass(frozen=True, slots=True)
class Fit:
    """What a servo reported about its own settings. It is replaced as a whole, never changed."""

    mode: GoalKind = "position"
    limits: tuple[float, float] | None = None
    """Its stored limits in its unit; None: it has none, or was not asked yet."""
    response_level: int | None = None
    """0: it answers PING and READ only; 1: it answers writes too; None: it was not asked yet."""


class HostServo:
    """Converts between the registers of a servo and its unit, and keeps what is known of the servo itself."""

    def __init__(self, name: str, options: SmsServo, model: SmsModel) -> None:
        self.name = name
        self.node = options.id
        self.options = options
        self.model = model
        self.calibration = options.calibration(model)
        self.position, self.time, self.speed = (model.registers[name] for name in model.goal)
        self.fit = Fit()
        self.held: Mapping[str, int] = {}
        """Raw acceleration and torque limit as last written; a name is absent while its value is not known. The mapping is
        replaced when one changes, never changed."""
        self.decode_feedback = self.block_decoder(*model.feedback)
        self.decode_state = self.block_decoder(*model.health)

    def learn(self, fit: Fit) -> None:
        """Keep what the servo reported. An equal fit is not replaced, so goals packed for it remain valid."""
        if fit != self.fit:
            self.fit = fit

    def hold(self, settings: Mapping[str, int]) -> None:
        """Keep what was written to the registers beside the goal."""
        if settings:
            self.held = {**self.held, **settings}

    # Registers

    def encode(self, register: Register, raw: int) -> bytes:
        """Return the bytes of a raw value. Raises LimitError with the servo's name where the register cannot hold it."""
        try:
            return register.encode(raw, self.model.byte_order)
        except LimitError as error:
            raise error.at(servo=self.name) from None

    def decode(self, register: Register, data: bytes) -> int:
        """Return the raw value in these bytes."""
        return register.decode(data, self.model.byte_order)

    def read_raw(self, register: Register) -> Read[int]:
        """Return the READ of a register's raw value."""
        return RegisterRead(self.node, register, self.model.byte_order)

    def read_physical(self, register: Register) -> Read[Any]:
        """Return the READ of a register's physical value."""
        calibration, order = self.calibration, self.model.byte_order
        if register.unit not in ("position", "speed"):
            return RegisterRead(self.node, register, order, convert=self.converter(register))
        zero = calibration.zero if register.unit == "position" else 0.0
        linear = (register.scale, zero, calibration.direction, calibration.unit_per_step)
        return RegisterRead(self.node, register, order, linear=linear)

    def packer(self, registers: list[Register]) -> Callable[..., bytes]:
        """Return the function that packs one word for each of these registers, which follow one another."""
        return self._struct(registers[0].address, registers[-1].end, registers).pack

    def word_maker(self, register: Register) -> Callable[[int], int]:
        """Return the function from a raw value to the register's unsigned word; it raises LimitError outside `raw_range`."""
        low, high = register.raw_range
        sign = 0 if register.sign_bit is None else 1 << register.sign_bit

        def word(raw: int) -> int:
            if not low <= raw <= high:
                self.encode(register, raw)
            return raw if raw >= 0 else sign - raw

        return word

    # Units

    def converter(self, register: Register) -> Callable[[int], Any]:
        """Return the function from a raw value to the physical one, in the servo's unit where the register has such a unit."""
        scale, calibration = register.scale, self.calibration
        match register.unit:
            case "position":
                return lambda raw: calibration.to_unit(raw * scale)
            case "speed":
                return lambda raw: calibration.rate_to_unit(raw * scale)
            case "acceleration":
                return lambda raw: raw * scale * calibration.unit_per_step
            case _:
                return register.to_physical

    def to_physical(self, register: Register, raw: int) -> Any:
        """Return the physical value of a raw one."""
        return self.converter(register)(raw)

    def to_raw(self, register: Register, value: Any) -> int:
        """Return the raw value of a physical one. Raises LimitError for anything but a finite number."""
        if register.unit in CALIBRATED_UNITS and not is_number(value):
            raise LimitError(f"register {register.name}: {value!r} is not a finite number", servo=self.name)
        match register.unit:
            case "position":
                return round(self.calibration.to_raw(value) / register.scale)
            case "speed":
                return round(self.calibration.rate_to_raw(value) / register.scale)
            case "acceleration":
                return round(float(value) / self.calibration.unit_per_step / register.scale)
            case _:
                return register.to_raw(value)

    # Blocks

    def block_decoder(self, first: str, last: str) -> Callable[[bytes], Update]:
        """Return the function from the bytes of a block to fields of State. It unpacks the block once."""
        start, size = self.model.block(first, last)
        fields: Fields = [
            (field, register)
            for field, register in ((field, self.model.registers[name]) for field, name in self.model.state.items())
            if start <= register.address and register.end <= start + size
        ]
        fields.sort(key=lambda field: field[1].address)
        unpackers = []
        while fields:
            # Registers that overlap an earlier one are unpacked once more; the packaged models have none.
            layer, fields = _split_overlapping(fields)
            unpack = self._struct(start, start + size, [register for _, register in layer]).unpack
            unpackers.append((unpack, [(field, self._word_converter(field, register)) for field, register in layer]))

        def decode(data: bytes) -> Update:
            return {
                field: convert(word)
                for unpack, steps in unpackers
                for (field, convert), word in zip(steps, unpack(data), strict=True)
            }

        return decode

    def _word_converter(self, field: str, register: Register) -> Callable[[int], Any]:
        """Return the function from the unsigned word on the wire to the field's value."""
        if field == "moving":
            return bool
        convert = self.converter(register)
        if register.sign_bit is None:
            return convert
        sign = 1 << register.sign_bit
        return lambda word: convert(-(word & sign - 1) if word & sign else word)

    def _struct(self, start: int, end: int, registers: list[Register]) -> Struct:
        """Return the struct of these registers, which are in order and do not overlap; it skips the bytes between them."""
        layout = ">" if self.model.byte_order == "big" else "<"
        for register in registers:
            layout += "x" * (register.address - start) + STRUCT_CODES[register.size]
            start = register.end
        return Struct(layout + "x" * (end - start))


def _split_overlapping(fields: Fields) -> tuple[Fields, Fields]:
    """Return the fields whose registers do not overlap (sorted by address), and the others."""
    separate: Fields = []
    others: Fields = []
    for field in fields:
        overlaps = separate and field[1].address < separate[-1][1].end
        (others if overlaps else separate).append(field)
    return separate, others
