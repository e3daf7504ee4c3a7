"""What is done to a hand once, by a person: a new unit, a restart, calibration, firmware update (seed 4.1).

Each is one write of one register, never repeated and never part of a longer one. These plans belong in an exclusive session,
which sees to it that nothing is enabled.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from servobus.errors import DeviceError, LimitError, NotSupported, ReplyTimeout
from servobus.protocols import base
from servobus.protocols.base import Plan, ask
from servobus.protocols.modbus.codec import MAX_UNIT
from servobus.protocols.modbus.requests import ReadHolding
from servobus.protocols.roh.hand import Hand
from servobus.values import Change, known_command

RESTART_PATIENCE = 1.7
"""Seconds the first question after a restart may take; asked three times, that is the 5 s a restart is given."""


@dataclass(frozen=True, slots=True)
class Command:
    """One word of one register."""

    register: str
    word: int | None
    """None: the caller says it."""
    meaning: str


COMMANDS = {
    "restart": Command("reset", 0, "restarts it, in work mode"),
    "firmware_update": Command("reset", 1, "restarts it into its boot loader: it is no unit any more until it has a firmware"),
    "start_init": Command("start_init", 1, "begins the self-test it waits for: the fingers move"),
    "zero_force": Command("reset_force", 1, "makes what the force sensors feel now nothing"),
    "power_off": Command("power_off", 1, "switches it off; documented as not available yet"),
    "recalibrate": Command("recalibrate", None, "begins the calibration, with the vendor's own value: the fingers move"),
}
"""What is never repeated, and never part of a longer write."""


class Commissioning(base.Commissioning):
    """`hand_of`: the hand of a unit, configured or not."""

    commands: ClassVar = {name: command.meaning for name, command in COMMANDS.items()}

    def __init__(self, hand_of: Callable[[int], Hand]) -> None:
        self._hand_of = hand_of

    def set_id(self, node: int, new: int, *, save: bool = False) -> Plan[Change]:
        """The hand saves its unit, wanted or not, and restarts; then it is looked for there. Raises LimitError at once;
        ReplyTimeout when nobody answers at `new`, DeviceError when who answers there says otherwise."""
        if not 1 <= new <= MAX_UNIT or new == node:
            raise LimitError(f"unit {new} is outside 1 to {MAX_UNIT}, or is its unit already: nothing was sent")
        return self._set_unit(self._hand_of(node), new)

    def set_baudrate(self, node: int, baudrate: int, *, save: bool = False) -> Plan[Change]:
        raise NotSupported("a ROH hand has no register for its baud rate: nothing was sent")

    def _set_unit(self, hand: Hand, new: int) -> Plan[Change]:
        taken = True
        try:
            yield from ask(ReadHolding(hand.timing, new, hand.probe().address, 1, list))
        except ReplyTimeout:
            taken = False
        if taken:
            raise DeviceError(f"unit {new} answers already: two hands with one unit would talk at once. Choose a free one")
        yield from self._command(hand, "node_id", new)
        address = hand.map.named("node_id").address
        request = ReadHolding(hand.timing, new, address, 1, lambda words: words[0] & 0xFF)
        request.service_time = RESTART_PATIENCE
        told = yield from ask(request)
        if told != new:
            raise DeviceError(f"who answers as unit {new} says it is unit {told}: is another hand on this line?")
        return Change(hand.unit, "id", new, saved=True, pending_reboot=False)

    def command(self, node: int, name: str, value: int | None = None) -> Plan[tuple[str, ...]]:
        known_command(self.commands, name)
        command = COMMANDS[name]
        word = command.word if value is None else value
        if (value is None) is (command.word is None) or word is None or not 0 <= word <= 0xFFFF:
            wanted = "takes no value" if command.word is not None else "needs a value of 0 to 65535"
            raise LimitError(f"{name} {wanted}: nothing was sent")
        return self._tell(self._hand_of(node), command.register, word)

    def _tell(self, hand: Hand, register: str, word: int) -> Plan[tuple[str, ...]]:
        yield from self._command(hand, register, word)
        return ()

    @staticmethod
    def _command(hand: Hand, name: str, word: int) -> Plan[None]:
        """One word, said once. A hand that restarts on it need not answer."""
        yield from hand.attach()
        if name not in hand.map.registers:
            raise NotSupported(f"a hand with the register map {hand.map.name} has no register {name}")
        restarts = name in ("node_id", "reset")
        try:
            yield from hand.explained(ask(hand.write(hand.map.named(name).address, [word], repeat=False)))
        except ReplyTimeout:
            if not restarts:
                raise
        if restarts:
            hand.forget()
