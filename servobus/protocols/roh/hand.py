"""One hand on the line: which register map it has, and why it refuses.

One number is a speed in one map and a target in another. So the hand is asked for its map (the high byte of register 1000), and
nothing is written to it before that, nor while its map is not the one that the config pins.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

from servobus.errors import DeviceError, ServobusError
from servobus.protocols.base import Plan, Request, ask
from servobus.protocols.modbus.requests import (
    DEVICE_FAILURE,
    NO_ANSWER,
    ReadHolding,
    RtuTiming,
    UnitRead,
    WriteMultiple,
    WriteSingle,
)
from servobus.protocols.roh.finger import Finger
from servobus.protocols.roh.model import NEWEST, RohModel
from servobus.protocols.roh.options import MAPS
from servobus.protocols.roh.spans import Limits, Span, read_spans
from servobus.values import Identity, Update

R = TypeVar("R")

FIRST = 1000
"""The first register; the map, the versions and the hardware can be told from the first four."""
IDENTITY_COUNT = 4
SUB_EXCEPTIONS = {
    1: "it is still initialising: wait, then try again",
    2: "it waits for its calibration: finish that first",
    3: "it does not take that value",
    4: "a motor is stuck: free the finger",
    5: "the operation failed",
    6: "saving failed",
}
"""ROH Modbus, 3.4."""
LITE = 0x25
"""High byte of the hardware version of the LiteS001."""
HARDWARE = {0x1B: "ROH-A001 or A002", 0x20: "ROH-AP001", LITE: "ROH-LiteS001"}
"""High byte of the hardware version -> product."""


@dataclass(frozen=True, slots=True)
class HandFit:
    """What a hand reported of itself, and whether that fits the config. Replaced as a whole."""

    model: RohModel | None = None
    """Its register map; None: not known."""
    obstacle: str = "it was not asked yet for its register map: is it powered, are id and baud rate right?"
    """Why nothing may be written to it; empty: it may be written."""
    gap: int | None = None
    """An address across which it cannot be read."""


NOT_ASKED = HandFit()
REPLACED = HandFit(obstacle="another hand answers in its place: it was not asked yet for its register map")


@dataclass(frozen=True, slots=True)
class RegisterValue:
    """A register of a finger and its raw value."""

    finger: Finger
    name: str
    raw: int


class Hand:
    """One unit. `limits` are those of the line, shared by all hands."""

    def __init__(
        self,
        unit: int,
        fingers: Sequence[Finger],
        pinned: str,
        models: Mapping[str, RohModel],
        timing: RtuTiming,
        limits: Limits,
        *,
        single_writes: bool,
    ) -> None:
        """`pinned`: the map that the config names, or auto. `single_writes`: write one register with function 0x06."""
        self.unit = unit
        self.fingers = fingers
        self.pinned = pinned
        self.timing = timing
        self.limits = limits
        self.fit = NOT_ASKED
        self._single_writes = single_writes
        self._models = models

    @property
    def map(self) -> RohModel:
        """The map to read by. While it is not known: one to plan with, whose values are refused (see `trusted`)."""
        return self.fit.model or self._models[NEWEST if self.pinned == "auto" else self.pinned]

    # Which map

    def identity_read(self) -> ReadHolding[Sequence[int]]:
        """Return the read of the registers that tell the map."""
        return UnitRead(self.timing, self.unit, FIRST, IDENTITY_COUNT, list)

    def attach(self) -> Plan[None]:
        """Ask for the map if it is not known. Raises DeviceError where nothing may be written."""
        if self.fit.model is None:
            self.learn((yield from ask(self.identity_read())))
        if self.fit.obstacle:
            raise DeviceError(self.fit.obstacle)

    def learn(self, registers: Sequence[int]) -> None:
        """Take the first registers of the hand."""
        before = self.fit.model
        model = map_of(registers, [self._models[name] for name in MAPS])
        gap = model.lite_gap if model is not None and _hardware(model, registers) >> 8 == LITE else None
        self.fit = HandFit(model, self._obstacle(model, registers), gap)
        if before is not None and model is not before:
            self.forget()

    def _obstacle(self, model: RohModel | None, registers: Sequence[int]) -> str:
        if model is None:
            return (
                f"its registers 1000 and 1001 read {_first_two(registers, ' and ')}, none of the maps {', '.join(MAPS)}: "
                "nothing is written to it. Is its firmware one for another protocol?"
            )
        if self.pinned not in ("auto", model.name):
            return (
                f"it has the register map {model.name}, the config pins {self.pinned}: nothing is written to it. "
                f"Set units: {{{self.unit}: {{model: {model.name}}}}}"
            )
        return ""

    def is_replaced(self, registers: Sequence[int]) -> bool:
        """Return whether the first registers, read again, are those of another hand. Its map has to be asked for again then."""
        if self.fit.model is None or self.fit.model.fits(registers):
            return False
        self.fit = REPLACED
        self.forget()
        return True

    def forget(self) -> None:
        """The hand has restarted, or it is another one: what its registers hold is not known."""
        for finger in self.fingers:
            finger.forget()

    # Reading and writing

    def read(self, span: Span, make: Callable[[Sequence[int]], R]) -> ReadHolding[R]:
        """Return the read of any registers. A gateway's refusal is an answer: it refuses an illegal address in the same way."""
        return ReadHolding(self.timing, self.unit, span.start, span.count, make)

    def read_state(self, span: Span, make: Callable[[Sequence[int]], R]) -> ReadHolding[R]:
        """Return a read of registers that the hand has: a gateway's refusal is silence."""
        return UnitRead(self.timing, self.unit, span.start, span.count, make)

    def write(self, address: int, values: Sequence[int], *, repeat: bool = True) -> Request[None]:
        if self._single_writes and len(values) == 1:
            return WriteSingle(self.timing, self.unit, address, values[0], repeat=repeat)
        return WriteMultiple(self.timing, self.unit, address, values, repeat=repeat)

    def trusted(self, model: RohModel, make: Callable[[Sequence[int]], R]) -> Callable[[Sequence[int]], R]:
        """Return `make`, which raises DeviceError if the map of the read turns out not to be the hand's."""

        def make_if_right(registers: Sequence[int]) -> R:
            if self.fit.model is not model:
                raise DeviceError(self.fit.obstacle or f"it turned out to have the register map {self.map.name}: ask again")
            return make(registers)

        return make_if_right

    def updates(self, model: RohModel, span: Span, registers: Sequence[int], fingers: Sequence[Finger]) -> dict[str, Update]:
        """Return what a poll brings; nothing if its map is not the hand's."""
        if self.fit.model is not model:
            return {}
        return {finger.name: update for finger in fingers if (update := finger.decode(model, span, registers))}

    def spans(self, addresses: Iterable[int]) -> list[Span]:
        """Return the cheapest reads of these addresses."""
        return read_spans(addresses, self.limits.read, self.fit.gap)

    def read_values(self, names: Mapping[Finger, Sequence[str]], *, pause: float = 0.0) -> Plan[list[RegisterValue]]:
        """Read registers of several fingers, in the fewest reads. Raises DeviceError for an incomplete reply.

        `pause`: seconds of silence after the last of them.
        """
        model = self.map
        wanted = [(finger, name, finger.address(model, name)) for finger, some in names.items() for name in some]
        values: dict[int, int] = {}
        spans = self.spans(address for _, _, address in wanted)
        for span in spans:
            request = self.read_state(span, list)
            if span is spans[-1]:
                request.quiet_after = max(request.quiet_after, pause)
            registers = yield from ask(request)
            if not registers or len(registers) != span.count:
                raise DeviceError(f"its reply to a read of {span.count} registers is incomplete: read again")
            values.update(zip(range(span.start, span.end), registers, strict=True))
        return [RegisterValue(finger, name, model.named(name).from_word(values[address])) for finger, name, address in wanted]

    # Restarts

    def is_kept(self, names: Mapping[Finger, Sequence[str]]) -> Plan[bool]:
        """Return whether registers hold what they held; False: the hand has restarted. So has one that initialises."""
        try:
            values = yield from self.read_values(names)
        except DeviceError as error:
            if error.code != DEVICE_FAILURE:
                raise
        else:
            if all(value.finger.is_kept(value.name, value.raw) for value in values):
                return True
        self.forget()
        return False

    # Refusals

    def explained(self, plan: Plan[R]) -> Plan[R]:
        """Run a plan. After a device failure, or a gateway's refusal, ask the hand once for the reason (ROH Modbus, 3.4)."""
        try:
            return (yield from plan)
        except DeviceError as error:
            raise (yield from self.explain(error)) from None

    def explain(self, error: DeviceError) -> Plan[DeviceError]:
        if error.code not in (DEVICE_FAILURE, NO_ANSWER):
            return error
        address = self.map.named("sub_exception").address
        try:
            (code,) = yield from ask(self.read(Span(address, 1), list))
        except ServobusError:
            return error
        if not code:
            return error
        meaning = f"{SUB_EXCEPTIONS.get(code, 'a sub-exception that is not documented')} ({code})"
        if error.message.endswith(meaning):
            return error  # a step of the same plan has asked already
        qualifier = "" if error.code == DEVICE_FAILURE else "its last sub-exception: "
        return DeviceError(
            f"{error.message}; {qualifier}{meaning}",
            code=error.code,
            request=error.request,
            raw=error.raw,
            servo=error.servo,
        )


def map_of(registers: Sequence[int], models: Iterable[RohModel]) -> RohModel | None:
    """Return the map that the first registers of a hand tell. None for an unknown one, and for too few registers."""
    if len(registers) < IDENTITY_COUNT:
        return None
    return next((model for model in models if model.fits(registers)), None)


def identity(registers: Sequence[int], models: Iterable[RohModel]) -> Identity:
    """Return who a hand is, from its first registers."""
    model = map_of(registers, models)
    if model is None:
        return Identity(product=f"unknown map: registers 1000 and 1001 read {_first_two(registers, ', ')}")
    start = model.named("fw_version").address - FIRST
    firmware, revision = registers[start : start + 2]
    hardware = _hardware(model, registers)
    product = HARDWARE.get(hardware >> 8, f"ROH hardware 0x{hardware:04X}")
    return Identity(model=model.name, product=product, firmware=f"{firmware >> 8}.{firmware & 0xFF}.{revision}", mode="position")


def _hardware(model: RohModel, registers: Sequence[int]) -> int:
    return registers[model.named("hw_version").address - FIRST]


def _first_two(registers: Sequence[int], separator: str) -> str:
    return separator.join(f"0x{register:04X}" for register in registers[:2]) or "nothing"
