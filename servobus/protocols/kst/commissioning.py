"""Gives a KST servo its id and baud rate (KST RS422, 3.1 to 3.3): one change at a time, on one servo, read back, saved on
request.

A change takes effect after save and restart. Until then the servo is addressed as before, the change is `pending`, and a second
change of that servo is refused. After a restart, `restarted` finds out what became of the change: a saved id answers now, and
what was not saved is lost. These plans run in an exclusive session, in which no servo is enabled. Ids and rates are never sent
again.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import ClassVar

from servobus.errors import DeviceError, LimitError, NotSupported, ReplyTimeout
from servobus.protocols.base import Commissioning, Plan, ask
from servobus.protocols.kst.codec import SAVE_DATA, Command
from servobus.protocols.kst.identity import observe
from servobus.protocols.kst.options import KstBus
from servobus.protocols.kst.requests import Read, RequestSettings, Save, SetValue, UnansweredCommand
from servobus.values import Change, check_command

DOUBTFUL_ID = 0xFF
"""The document allows it as an address, but an idle line reads as 0xFF."""


class KstCommissioning(Commissioning):
    """Keeps the changes that wait for a restart."""

    commands: ClassVar = {"save": "writes its settings to flash"}

    def __init__(self, options: KstBus, settings: RequestSettings) -> None:
        self.options = options
        self.settings = settings
        self.pending: dict[int, Change] = {}
        """Node -> its change that is not in effect yet."""

    def set_id(self, node: int, new: int, *, save: bool = False) -> Plan[Change]:
        first, last = self.options.id_range
        if not first <= new <= last:
            raise LimitError(f"id {new} is outside {first} to {last} (id_range): nothing was sent")
        reserved = {change.value for other, change in self.pending.items() if change.what == "id" and other != node}
        if new in ({servo.id for servo in self.options.servos.values()} | reserved) - {node}:
            raise LimitError(f"id {new} belongs to another servo of this bus: nothing was sent. Choose a free one")
        self._refuse_second(node)
        return self._change(Change(node, "id", new, notes=tuple(_id_notes(new))), Command.SET_ID, new, save)

    def set_baudrate(self, node: int, baudrate: int, *, save: bool = False) -> Plan[Change]:
        """Return the plan that gives a node another baud rate.

        No command reads the rate back. What is confirmed is that the servo repeats it, and that it still answers.
        """
        codes = [code for code, rate in self.options.baud_table.items() if rate == baudrate]
        if not codes:
            rates = ", ".join(map(str, sorted(self.options.baud_table.values())))
            raise LimitError(f"baud rate {baudrate} is not one of {rates}: nothing was sent")
        self._refuse_second(node)
        return self._change(Change(node, "baudrate", baudrate), Command.SET_BAUD, codes[0], save)

    def command(self, node: int, name: str, value: int | None = None) -> Plan[tuple[str, ...]]:
        check_command(self.commands, name)
        if value is not None:
            raise LimitError(f"{name} takes no value: nothing was sent")
        return self.save(node)

    def save(self, node: int) -> Plan[tuple[str, ...]]:
        """Return the plan that writes the servo's settings to its flash, once. It returns notes for a person."""
        notes: tuple[str, ...] = ()
        if self.options.save_reply == "none":
            yield from ask(UnansweredCommand(self.settings, node, Command.SAVE, SAVE_DATA))
        else:
            try:
                yield from ask(Save(self.settings, node))
            except (ReplyTimeout, DeviceError) as error:
                if self.options.save_reply == "required":
                    raise
                if isinstance(error, DeviceError):
                    notes = (error.message,)
        if node in self.pending:
            self.pending[node] = replace(self.pending[node], saved=not notes)
        return notes

    def restarted(self, node: int) -> Plan[int | None] | None:
        """Return the plan that finds out to which id a restarted servo answers; None where no change of it is pending.

        The plan asks the saved new id first, then the old one, and ends the pending change with the first that answers for
        itself. It returns that id. It returns None, and the change stays pending, where neither does.
        """
        return self._restarted(self.pending[node]) if node in self.pending else None

    def answered(self, node: int) -> None:
        """A scan has found this id: the saved change to it is in effect."""
        for old, change in list(self.pending.items()):
            if change.what == "id" and change.saved and change.value == node:
                del self.pending[old]

    def own_ids(self, node: int) -> tuple[int, ...]:
        """Return the ids that this servo may report: the document does not say whether a new one shows before the restart."""
        change = self.pending.get(node)
        return (node, change.value) if change is not None and change.what == "id" else (node,)

    def ask_new_id(self, node: int) -> Plan[int | None]:
        """Return the plan that ends a saved change of this node's id if the new id answers. It returns that id, or None."""
        change = self.pending.get(node)
        if change is None or change.what != "id" or not change.saved:
            return None
        return (yield from self._confirm(change, change.value))

    def _restarted(self, change: Change) -> Plan[int | None]:
        return (yield from self.ask_new_id(change.node)) or (yield from self._confirm(change, change.node))

    def _confirm(self, change: Change, node: int) -> Plan[int | None]:
        """End the change if this id answers for itself."""
        try:
            reported = yield from ask(self._read_id(node))
        except (ReplyTimeout, DeviceError):
            return None
        if reported != node:
            return None
        self.pending.pop(change.node, None)
        return node

    def _refuse_second(self, node: int) -> None:
        if node in self.pending:
            raise NotSupported(f"{self.pending[node]}. One change at a time: nothing was sent")

    def _change(self, change: Change, command: Command, value: int, save: bool) -> Plan[Change]:
        """Check that it is one servo and the new id is free, set the value, read the id back, and save.

        With `id_effective: immediate` the servo answers at its new id at once. After a new rate it cannot be read back then,
        because the line has to change its rate first.
        """
        immediate = self.options.id_effective == "immediate"
        address = value if immediate and change.what == "id" else change.node
        if change.what == "id" and change.value != change.node:
            yield from self._expect_silence(change.value)
        suspicion = (yield from observe(self.settings, change.node)).suspicion
        if suspicion:
            raise DeviceError(f"{suspicion}. Nothing was changed")
        also = address if address != change.node else None
        yield from ask(SetValue(self.settings, change.node, command, bytes((value,)), also=also))
        if immediate:
            change = replace(change, pending_reboot=False)
        else:
            self.pending[change.node] = change
        if not (immediate and change.what == "baudrate"):
            yield from self._read_back(change, address)
        if not save:
            return change
        notes = yield from self.save(address)
        return replace(change, saved=not notes, notes=change.notes + notes)

    def _expect_silence(self, node: int) -> Plan[None]:
        try:
            yield from ask(self._read_id(node))
        except ReplyTimeout:
            return
        raise DeviceError(f"id {node} answers already: choose a free one. Nothing was changed")

    def _read_back(self, change: Change, node: int) -> Plan[None]:
        reported = yield from ask(self._read_id(node))
        if reported not in (*self.own_ids(node), node):
            raise DeviceError(f"after {change.what} {change.value} was set, the servo reports id {reported}: do not save it")

    def _read_id(self, node: int) -> Read[int]:
        return Read(self.settings, node, Command.READ_ID, lambda data: data[0], once=True)


def _id_notes(new: int) -> Iterator[str]:
    if new == DOUBTFUL_ID:
        yield "id 255 is what a silent line reads as: choose another if you can"
