"""The host's half of one configured FEETECH servo: its units, what it reported, and the meaning of its blocks of registers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from struct import Struct
from typing import Any

from servobus.errors import LimitError
from servobus.protocols.model import Register
from servobus.protocols.sms.model import LIMITS, SmsModel
from servobus.protocols.sms.options import SmsServo
from servobus.protocols.sms.requests import Read, RegisterRead
from servobus.values import Calibration, Loss, Update, is_number

STRUCT_CODES = {1: "B", 2: "H", 4: "I"}
"""Bytes of a register -> its code for `struct`; signs are sign and magnitude, so every register is unsigned on the wire."""
Fields = list[tuple[str, Register]]
"""Field of State, register that holds it."""
TORQUE_ON = 1
"""Of the torque register: 0 is off, 2 is damping (FEETECH memory table, address 40)."""
CALIBRATED_UNITS = frozenset({"position", "speed", "acceleration"})
"""Units of registers that the servo's calibration turns into its own unit."""


UNKNOWN = "unknown"
"""The mode of a servo whose memory table is not that of its model."""


@dataclass(frozen=True, slots=True)
class Fit:
    """What a servo reported about its own settings. It is replaced as a whole, never changed. The default is a servo that was not
    asked yet: it may be previewed, and is neither enabled nor held."""

    mode: str = "position"
    """A mode of its model, "mode N", or UNKNOWN."""
    raw_limits: tuple[int, int] | None = None
    """Its stored limits in raw steps; None: it has none."""
    response_level: int | None = None
    """0: it answers PING and READ only; 1: it answers writes too."""
    speed_scale: float | None = None
    """Steps/s of a count of speed; None: as the model says."""
    obstacle: str = ""
    """Why it must not be moved; empty: it may be moved."""
    identified: bool = False
    units: Mapping[str, float] | None = None
    """Units of a product whose steps have another size than its model says."""

    @property
    def takes(self) -> str | None:
        """The kind of goals that it takes: "position", "velocity", or None."""
        return self.mode if self.mode in ("position", "velocity") and not self.obstacle else None


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
        self.takes = self.fit.takes
        self.answers_writes = True
        """Whether it acknowledges writes: as the config says, until it was asked."""
        self.held: Mapping[str, int] = {}
        """Raw acceleration and torque limit as last written; a name is absent while its value is not known. The mapping is
        replaced when one changes, never changed."""
        self._unconfirmed: Mapping[str, int] = {}
        """Settings that were sent once in a frame that has no reply."""
        self.reads: dict[tuple[str, bool], Read[Any]] = {}
        """Reads of registers that were made already, by name and `raw`; they follow from what it reported."""
        self.own: Mapping[str, int] = {}
        """Raw acceleration and torque limit that `enable` read: a goal that names none leaves the servo at them."""
        self.guard_span = self._guard_span()
        self.decode_guards = self.block_decoder(*self.guard_span)
        self.decode_feedback = self.block_decoder(*model.feedback)
        self.decode_state = self.block_decoder(*model.health)

    def _guard_span(self) -> tuple[str, str]:
        """First and last of the registers that tell whether an enabled servo is as it was left: torque and sentinel."""
        guards = [self.model.registers[name] for name in (self.model.torque, self.model.sentinel.name)]
        first, last = sorted(guards, key=lambda register: register.address)
        return first.name, last.name

    def learn(self, fit: Fit) -> None:
        """Keep what the servo reported. An equal fit is not replaced, so goals packed for it remain valid."""
        if fit != self.fit:
            self.fit, self.takes = fit, fit.takes
            self.calibration = self._calibration()
            self.reads.clear()
        if fit.response_level is not None:
            self.answers_writes = fit.response_level != 0

    def _calibration(self) -> Calibration:
        """Return the conversion between raw steps and its unit, for the product that it is."""
        calibration = self.options.calibration(self.model)
        size = (self.fit.units or {}).get(self.options.unit or next(iter(self.model.units)))
        return calibration if size is None else replace(calibration, unit_per_step=size / self.options.gear)

    @property
    def limits(self) -> tuple[float, float] | None:
        """Its stored limits in its unit, the lower one first; None: it has none, or was not asked yet."""
        ends = self.fit.raw_limits
        if ends is None:
            return None
        low, high = sorted(self.calibration.to_unit(end) for end in ends)
        return low, high

    def hold(self, settings: Mapping[str, int]) -> None:
        """Keep what was written to the registers beside the goal."""
        if settings:
            self.held = {**self.held, **settings}

    def sent(self, settings: Mapping[str, int], *, acknowledged: bool) -> None:
        """Note that a goal brought these settings. A frame without a reply may be lost, so it has to bring them twice."""
        if acknowledged or settings == self._unconfirmed:
            self.hold(settings)
            settings = {}
        self._unconfirmed = settings

    def forget(self, settings: Mapping[str, int]) -> None:
        """Note that these registers are being written, so that their values are not known until the write is done."""
        if settings:
            self.held = {name: raw for name, raw in self.held.items() if name not in settings}

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
        if register.unit != "position":
            return RegisterRead(self.node, register, order, convert=self.converter(register))
        linear = (register.scale, calibration.zero, calibration.direction, calibration.unit_per_step)
        return RegisterRead(self.node, register, order, linear=linear)

    def read_registers(self, names: Iterable[str], *, more: int = 0) -> Read[dict[str, int]]:
        """Return one READ of several registers, by name; `more` bytes behind them give its reply another length."""
        registers = [self.model.registers[name] for name in dict.fromkeys(names)]
        start = min(register.address for register in registers)
        size = max(register.end for register in registers) - start + more

        def decode(data: bytes) -> dict[str, int]:
            return {each.name: self.decode(each, data[each.address - start : each.end - start]) for each in registers}

        return Read(self.node, start, size, decode)

    def read_motion(self, *, more: int = 0) -> Read[dict[str, int]]:
        """Return the READ of everything that an e-stop asks for: mode, torque, sentinel, goal, position and whether it moves."""
        model, state = self.model, self.model.state
        measured = [register for field, register in state.items() if field in ("position", "moving")]
        return self.read_registers((*model.mode_registers, model.torque, model.sentinel.name, *model.goal, *measured), more=more)

    def in_unit(self, register: Register) -> Register:
        """Return the register that holds what a name means in the servo's unit.

        The lower limit of a joint that is mounted the other way round is the servo's upper one.
        """
        if self.calibration.direction > 0 or register.name not in LIMITS:
            return register
        return self.model.registers[LIMITS[1 - LIMITS.index(register.name)]]

    def packer(self, registers: list[Register]) -> Callable[..., bytes]:
        """Return the function that packs one word for each of these registers, which follow one another."""
        return self._struct(registers[0].address, registers[-1].end, registers).pack

    def word_maker(self, register: Register) -> Callable[[int], int]:
        """Return the function from a raw value to the register's unsigned word; it raises LimitError outside its range.

        The range of the goal position is the servo's own: that of its register, or its stored limits where they are tighter.
        """
        low, high = register.raw_range
        if register is self.position and self.fit.raw_limits is not None:
            low, high = max(low, self.fit.raw_limits[0]), min(high, self.fit.raw_limits[1])
        sign = 0 if register.sign_bit is None else 1 << register.sign_bit

        def word(raw: int) -> int:
            if not low <= raw <= high:
                self.encode(register, raw)
                self._refuse_beyond_limits(raw)
            return raw if raw >= 0 else sign - raw

        return word

    def _refuse_beyond_limits(self, raw: int) -> None:
        low, high = self.limits or (0.0, 0.0)
        raise LimitError(
            f"position {self.calibration.to_unit(raw):.4g} is outside the servo's own stored limits {low:.4g} to {high:.4g}: "
            f"nothing was sent. They are its registers {' and '.join(LIMITS)}",
            servo=self.name,
        )

    # Units

    def converter(self, register: Register) -> Callable[[int], Any]:
        """Return the function from a raw value to the physical one, in the servo's unit where the register has such a unit."""
        scale = register.scale
        match register.unit:
            case "position":
                return lambda raw: self.calibration.to_unit(raw * scale)
            case "speed":
                return lambda raw: self.calibration.rate_to_unit(raw * (self.fit.speed_scale or scale))
            case "acceleration":
                return lambda raw: raw * scale * self.calibration.unit_per_step
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
                return round(self.calibration.rate_to_raw(value) / (self.fit.speed_scale or register.scale))
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
        guards = [("energised", self.model.registers[self.model.torque])]
        guards.append(("loss", self.model.registers[self.model.sentinel.name]))
        guarded = all(start <= register.address and register.end <= start + size for _, register in guards)
        fields += guards if guarded else []
        fields.sort(key=lambda field: field[1].address)
        unpackers = []
        while fields:
            # Registers that overlap an earlier one are unpacked once more; the packaged models have none.
            layer, fields = _split_overlapping(fields)
            unpack = self._struct(start, start + size, [register for _, register in layer]).unpack
            unpackers.append((unpack, [(field, self._word_converter(field, register)) for field, register in layer]))

        reset, torque_on, torque_off, restarted = self.model.sentinel.reset, TORQUE_ON, Loss.TORQUE_OFF, Loss.RESTARTED

        def decode(data: bytes) -> Update:
            update: Update = {
                field: convert(word)
                for unpack, steps in unpackers
                for (field, convert), word in zip(steps, unpack(data), strict=True)
            }
            if guarded:
                torque = update["energised"]
                lost = restarted if update["loss"] == reset else None
                update["loss"] = lost or (None if torque == torque_on else torque_off)
                update["energised"] = torque != 0
            return update

        return decode

    def _word_converter(self, field: str, register: Register) -> Callable[[int], Any]:
        """Return the function from the unsigned word on the wire to the field's value."""
        if field == "moving":
            return bool
        convert = int if field in ("energised", "loss") else self.converter(register)
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
