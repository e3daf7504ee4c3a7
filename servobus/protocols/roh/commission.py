"""What is done to a hand once, by a person: a new unit, a restart, calibration, firmware update (seed 4.1).

Each is one write of one register, never repeated and never part of a longer one. These plans belong in an exclusive session,
which sees to it that nothing is enabled.
"""

from __future__ import annotations

from collections.abc import Callable

from servobus.errors import DeviceError, LimitError, NotSupported, ReplyTimeout
from servobus.protocols.base import Plan, ask
from servobus.protocols.modbus.codec import MAX_UNIT
from servobus.protocols.modbus.requests import ReadHolding
from servobus.protocols.roh.hand import Hand

RESTART_PATIENCE = 1.7
"""Seconds the first question after a restart may take; asked three times, that is the 5 s a restart is given."""


class Commissioning:
    """`hand_of`: the hand of a unit, configured or not."""

    def __init__(self, hand_of: Callable[[int], Hand]) -> None:
        self._hand_of = hand_of

    def set_unit(self, unit: int, new: int) -> Plan[int]:
        """The hand saves its unit and restarts; then it is looked for there. Raises LimitError at once; ReplyTimeout when nobody
        answers at `new`, DeviceError when who answers there says otherwise."""
        if not 1 <= new <= MAX_UNIT or new == unit:
            raise LimitError(f"unit {new} is outside 1 to {MAX_UNIT}, or is its unit already: nothing was sent")
        return self._set_unit(self._hand_of(unit), new)

    def _set_unit(self, hand: Hand, new: int) -> Plan[int]:
        taken = True
        try:
            yield from ask(ReadHolding(hand.wire, new, hand.probe().address, 1, list))
        except ReplyTimeout:
            taken = False
        if taken:
            raise DeviceError(f"unit {new} answers already: two hands with one unit would talk at once. Choose a free one")
        yield from self._command(hand, "node_id", new)
        address = hand.map.named("node_id").address
        request = ReadHolding(hand.wire, new, address, 1, lambda words: words[0] & 0xFF)
        request.service_time = RESTART_PATIENCE
        told = yield from ask(request)
        if told != new:
            raise DeviceError(f"who answers as unit {new} says it is unit {told}: is another hand on this line?")
        return new

    def restart(self, unit: int) -> Plan[None]:
        """To work mode."""
        return self._command(self._hand_of(unit), "reset", 0)

    def firmware_update(self, unit: int) -> Plan[None]:
        """The hand restarts into its boot loader and is no unit any more, until it has a firmware or is switched off."""
        return self._command(self._hand_of(unit), "reset", 1)

    def start_init(self, unit: int) -> Plan[None]:
        """For a hand that waits for its self-test: the fingers move."""
        return self._command(self._hand_of(unit), "start_init", 1)

    def zero_force(self, unit: int) -> Plan[None]:
        """What the force sensors feel now is nothing."""
        return self._command(self._hand_of(unit), "reset_force", 1)

    def power_off(self, unit: int) -> Plan[None]:
        """Documented as not available yet."""
        return self._command(self._hand_of(unit), "power_off", 1)

    def recalibrate(self, unit: int, key: int) -> Plan[None]:
        """`key`: the vendor's own value, which is not public."""
        if not 0 <= key <= 0xFFFF:
            raise LimitError(f"key {key} does not fit in a register: nothing was sent")
        return self._command(self._hand_of(unit), "recalibrate", key)

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
