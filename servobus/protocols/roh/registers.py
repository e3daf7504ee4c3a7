"""Registers of a hand by name: how they are read, which may be written, and how a write is confirmed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from servobus.errors import DeviceError, NotSupported
from servobus.protocols.base import Plan, Request, ask
from servobus.protocols.roh.finger import BY_UNIT, MAX_SPEED, Finger
from servobus.protocols.roh.hand import Hand
from servobus.protocols.roh.model import RohModel, RohRegister
from servobus.protocols.roh.spans import Span

FLASH_TIME = 0.5
"""Seconds a hand may need to save a setting; no document gives a time."""


def read_named(finger: Finger, hand: Hand, model: RohModel, name: str, *, raw: bool) -> Request[Any]:
    """Return the read of a register. Raises UnknownName, NotSupported."""
    model.readable(name)
    register = model.named(name)
    span = Span(register.address_of(finger.channel), register.length_of(finger.channel))
    if span.count > hand.limits.read:
        raise NotSupported(
            f"register {register.name} has {span.count} words, one read on this line {hand.limits.read}: read it in parts, "
            f"{span.start}:{hand.limits.read}",
            servo=finger.name,
        )

    def make(registers: Sequence[int]) -> Any:
        if span.count > 1:
            return list(registers)
        value = register.from_word(registers[0])
        return value if raw else finger.to_physical(register, value)

    return hand.read(span, hand.trusted(model, make))


@dataclass(frozen=True, slots=True)
class NamedWrite:
    """A write of one register by name. Made by `named_write`."""

    finger: Finger
    hand: Hand
    model: RohModel
    register: RohRegister
    raw: int

    def send(self) -> Plan[None]:
        """Write and read back, where it can be read. Not repeated where it is saved, or has an effect each time."""
        hand, register = self.hand, self.register
        yield from hand.attach()
        if hand.map is not self.model:
            raise DeviceError(f"it turned out to have the register map {hand.map.name}: nothing was written, ask again")
        saved = register.memory == "eeprom"
        address, word = register.address_of(self.finger.channel), register.to_word(self.raw)
        self.finger.held.before_write(register.name, self.raw)
        request = hand.write(address, [word], repeat=not saved and register.access == "rw")
        request.service_time = FLASH_TIME if saved else 0.0
        yield from ask(request)
        if register.access == "rw":
            yield from self._read_back(address, word)
        if register.name in ("speed", "current_limit"):
            self.finger.held.confirm(register.name, self.raw)
        if register.name == "current_limit":
            self.finger.own_current = self.raw

    def _read_back(self, address: int, word: int) -> Plan[None]:
        (reply,) = yield from ask(self.hand.read(Span(address, 1), list))
        if reply != word:
            raise DeviceError(
                f"register {self.register.name} reads {self.register.from_word(reply)} after {self.raw} was written: the hand "
                "did not accept it",
                servo=self.finger.name,
            )


def named_write(finger: Finger, hand: Hand, name: str, value: Any, *, raw: bool, persist: bool) -> NamedWrite:
    """Return the write of a register. Raises LimitError, UnknownName, NotSupported."""
    model = hand.map
    model.writable(name)
    register = model.named(name)
    register.address_of(finger.channel)
    _refuse(finger, register, persist)
    count = finger.check_raw(value) if raw else register.to_raw(value)
    register.to_word(count)
    if register.name == "speed":
        count = min(count, MAX_SPEED)
    return NamedWrite(finger, hand, model, register, count)


def _refuse(finger: Finger, register: RohRegister, persist: bool) -> None:
    """Refuse registers of other verbs, and writes that wear the memory without `persist`. Raises NotSupported."""
    reason = ""
    if register.guarded:
        reason = f"is not written by name: use commissioning ({register.guarded})"
    elif register.name in {target for target, _ in BY_UNIT.values()}:
        reason = "is not written by name: use move"
    elif register.length != 1:
        reason = "has several words, and is not written by name"
    elif register.memory == "eeprom" and not persist:
        reason = "is saved by the hand: add persist (--persist) to wear its memory"
    if reason:
        raise NotSupported(f"register {register.name} {reason}", servo=finger.name)
