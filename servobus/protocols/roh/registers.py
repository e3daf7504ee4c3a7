"""Registers of a hand by name: which may be written so, how they are read, and how a write is confirmed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from servobus.errors import DeviceError, NotSupported
from servobus.protocols.base import Plan, Request, ask
from servobus.protocols.roh.finger import BY_UNIT, Finger
from servobus.protocols.roh.hand import Hand
from servobus.protocols.roh.model import RohModel, RohRegister
from servobus.protocols.roh.spans import Span

SAVING = 0.5
"""Seconds a hand may take to save a setting; no document names a time."""


def read_named(finger: Finger, hand: Hand, model: RohModel, name: str, *, raw: bool) -> Request[Any]:
    """Raises UnknownName, NotSupported."""
    model.readable(name)
    register = model.named(name)
    span = Span(register.place(finger.channel), register.length(finger.channel))
    if span.count > hand.limits.read:
        raise NotSupported(
            f"register {register.name} is {span.count} words, the line carries {hand.limits.read} at once: read it in parts, "
            f"{span.start}:{hand.limits.read}",
            servo=finger.name,
        )

    def make(words: Sequence[int]) -> Any:
        if span.count > 1:
            return list(words)
        value = register.raw(words[0])
        return value if raw else finger.to_physical(register, value)

    return hand.read(span, hand.trusted(model, make))


@dataclass(frozen=True, slots=True)
class NamedWrite:
    """One register by name, and what shall stand there. Made by `named_write`."""

    finger: Finger
    hand: Hand
    model: RohModel
    register: RohRegister
    count: int
    """Raw."""

    def send(self) -> Plan[None]:
        """Never repeated where it is saved, or does something each time. Read back, where it can be read."""
        hand, register = self.hand, self.register
        yield from hand.attach()
        if hand.map is not self.model:
            raise DeviceError(f"it turned out to have the register map {hand.map.name}: nothing was written, ask again")
        saved = register.memory == "eeprom"
        address, word = register.place(self.finger.channel), register.word(self.count)
        self.finger.settings.pop(register.name, None)
        request = hand.write(address, [word], repeat=not saved and register.access == "rw")
        request.service_time = SAVING if saved else 0.0
        yield from ask(request)
        if register.access == "rw":
            yield from self._read_back(address, word)
        if register.name in ("speed", "current_limit"):
            self.finger.learn(register.name, self.count)

    def _read_back(self, address: int, word: int) -> Plan[None]:
        (found,) = yield from ask(self.hand.read(Span(address, 1), list))
        if found != word:
            raise DeviceError(
                f"register {self.register.name} reads {self.register.raw(found)} after {self.count} was written: the hand "
                "did not take it",
                servo=self.finger.name,
            )


def named_write(finger: Finger, hand: Hand, name: str, value: Any, *, raw: bool, persist: bool) -> NamedWrite:
    """Raises LimitError, UnknownName, NotSupported."""
    model = hand.map
    model.writable(name)
    register = model.named(name)
    register.place(finger.channel)
    refuse(finger, register, persist)
    count = finger.checked(value) if raw else register.to_raw(value)
    register.word(count)
    return NamedWrite(finger, hand, model, register, count)


def refuse(finger: Finger, register: RohRegister, persist: bool) -> None:
    """Registers that other verbs own, and what wears the memory without the word for it. Raises NotSupported."""
    reason = ""
    if register.guarded:
        reason = f"is not written by name: use commissioning ({register.guarded})"
    elif register.name in {target for target, _ in BY_UNIT.values()}:
        reason = "is not written by name: use move"
    elif register.words != 1:
        reason = "is several words, and not written by name"
    elif register.memory == "eeprom" and not persist:
        reason = "is saved by the hand: say persist (--persist) to wear its memory"
    if reason:
        raise NotSupported(f"register {register.name} {reason}", servo=finger.name)
