"""What a person does to a hand once: a new unit, a restart, calibration, firmware update (ROH Modbus, 4.1).

Each is one write of one register. It is never repeated, and never part of a longer write. These plans run in an exclusive
session, in which no servo is enabled.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from servobus.errors import DeviceError, LimitError, NotSupported, ReplyTimeout
from servobus.protocols.base import Commissioning, Plan, ask
from servobus.protocols.modbus.codec import MAX_UNIT
from servobus.protocols.modbus.requests import ReadHolding
from servobus.protocols.roh.hand import Hand
from servobus.values import Change, check_command

RESTART_PATIENCE = 1.7
"""Seconds the first request after a restart may take. It is tried three times, which makes the 5 s that a restart may take."""


@dataclass(frozen=True, slots=True)
class MaintenanceCommand:
    """A write of one register."""

    register: str
    value: int | None
    """None: the caller gives it."""
    effect: str


COMMANDS = {
    "restart": MaintenanceCommand("reset", 0, "restarts it, in work mode"),
    "firmware_update": MaintenanceCommand(
        "reset", 1, "restarts it into its boot loader: it does not answer as a unit until it has a new firmware"
    ),
    "start_init": MaintenanceCommand("start_init", 1, "begins the self-test it waits for: the fingers move"),
    "zero_force": MaintenanceCommand("reset_force", 1, "makes the present readings of the force sensors zero"),
    "power_off": MaintenanceCommand("power_off", 1, "switches it off; documented as not available yet"),
    "recalibrate": MaintenanceCommand(
        "recalibrate", None, "begins the calibration, with the vendor's own value: the fingers move"
    ),
}


class RohCommissioning(Commissioning):
    """Commissioning of hands, configured or not."""

    commands: ClassVar = {name: command.effect for name, command in COMMANDS.items()}

    def __init__(self, hand_of: Callable[[int], Hand]) -> None:
        """`hand_of`: returns the hand of a unit."""
        self._hand_of = hand_of

    def set_id(self, node: int, new: int, *, save: bool = False) -> Plan[Change]:
        """Return the plan that gives a hand another unit.

        The hand saves it in any case, and restarts. Raises LimitError at once; the plan raises ReplyTimeout where nothing answers
        at `new`, and DeviceError where `new` answers already, or another hand answers there.
        """
        if not 1 <= new <= MAX_UNIT or new == node:
            raise LimitError(f"unit {new} is outside 1 to {MAX_UNIT}, or is its unit already: nothing was sent")
        return self._set_unit(self._hand_of(node), new)

    def set_baudrate(self, node: int, baudrate: int, *, save: bool = False) -> Plan[Change]:
        raise NotSupported("a ROH hand has no register for its baud rate: nothing was sent")

    def _set_unit(self, hand: Hand, new: int) -> Plan[Change]:
        taken = True
        try:
            yield from ask(ReadHolding(hand.timing, new, hand.identity_read().address, 1, list))
        except ReplyTimeout:
            taken = False
        if taken:
            raise DeviceError(f"unit {new} answers already: two hands with one unit would reply at once. Choose a free one")
        yield from self._write(hand, "node_id", new)
        address = hand.map.named("node_id").address
        request = ReadHolding(hand.timing, new, address, 1, lambda registers: registers[0] & 0xFF)
        request.service_time = RESTART_PATIENCE
        reported = yield from ask(request)
        if reported != new:
            raise DeviceError(f"the hand at unit {new} reports unit {reported}: is another hand on this line?")
        return Change(hand.unit, "id", new, saved=True, pending_reboot=False)

    def command(self, node: int, name: str, value: int | None = None) -> Plan[tuple[str, ...]]:
        check_command(self.commands, name)
        command = COMMANDS[name]
        number = command.value if value is None else value
        if (value is None) is (command.value is None) or number is None or not 0 <= number <= 0xFFFF:
            expected = "takes no value" if command.value is not None else "needs a value of 0 to 65535"
            raise LimitError(f"{name} {expected}: nothing was sent")
        return self._command(self._hand_of(node), command.register, number)

    def _command(self, hand: Hand, register: str, value: int) -> Plan[tuple[str, ...]]:
        yield from self._write(hand, register, value)
        return ()

    @staticmethod
    def _write(hand: Hand, name: str, value: int) -> Plan[None]:
        """Write one register, once. A hand that restarts at it need not reply."""
        yield from hand.attach()
        if name not in hand.map.registers:
            raise NotSupported(f"a hand with the register map {hand.map.name} has no register {name}")
        restarts = name in ("node_id", "reset")
        try:
            yield from hand.explained(ask(hand.write(hand.map.named(name).address, [value], repeat=False)))
        except ReplyTimeout:
            if not restarts:
                raise
        if restarts:
            hand.forget()
