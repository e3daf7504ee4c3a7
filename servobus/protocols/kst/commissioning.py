"""Giving a servo its id and its baud rate (seed 3.1 to 3.3): one change at a time, on one servo, read back, saved on request.

A change counts only after save and restart, so the servo is spoken to as before until then, and a second change is refused:
`pending`. These plans belong in an exclusive session, which sees to it that nothing is enabled. Ids and rates are never retried.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import ClassVar

from servobus.errors import DeviceError, LimitError, NotSupported, ReplyTimeout
from servobus.protocols import base
from servobus.protocols.base import Plan, ask
from servobus.protocols.kst.codec import SAVE_WORD, Command
from servobus.protocols.kst.identity import look
from servobus.protocols.kst.options import KstBus
from servobus.protocols.kst.requests import Broadcast, Confirmed, FrameTiming, Read, Save, Tell
from servobus.values import Change, known_command

DOUBTFUL_ID = 0xFF
"""The seed allows it as an address; what idle lines look like is a bad name for a servo."""


class Commissioning(base.Commissioning):
    """Remembers which nodes wait for a restart."""

    commands: ClassVar = {"save": "writes its settings to flash"}

    def __init__(self, options: KstBus, timing: FrameTiming) -> None:
        self.options = options
        self.timing = timing
        self.pending: dict[int, Change] = {}

    def set_id(self, node: int, new: int, *, save: bool = False) -> Plan[Change]:
        """Raises LimitError, NotSupported at once; then DeviceError where two servos are suspected, or `new` answers already."""
        first, last = self.options.id_range
        if not first <= new <= last:
            raise LimitError(f"id {new} is outside {first} to {last} (id_range): nothing was sent")
        waiting = {change.value for other, change in self.pending.items() if change.what == "id" and other != node}
        if new in ({servo.id for servo in self.options.servos.values()} | waiting) - {node}:
            raise LimitError(f"id {new} belongs to another servo of this bus: nothing was sent. Choose a free one")
        self._refuse_second(node)
        return self._change(Change(node, "id", new, notes=tuple(_id_notes(new))), Command.SET_ID, new, save)

    def set_baudrate(self, node: int, baudrate: int, *, save: bool = False) -> Plan[Change]:
        """Raises LimitError, NotSupported at once; then DeviceError where two servos are suspected. No command reads the rate
        back: what is confirmed is the echo, and that the servo still answers."""
        codes = [code for code, rate in self.options.baud_table.items() if rate == baudrate]
        if not codes:
            known = ", ".join(map(str, sorted(self.options.baud_table.values())))
            raise LimitError(f"baud rate {baudrate} is none of {known}: nothing was sent")
        self._refuse_second(node)
        return self._change(Change(node, "baudrate", baudrate), Command.SET_BAUD, codes[0], save)

    def command(self, node: int, name: str, value: int | None = None) -> Plan[tuple[str, ...]]:
        known_command(self.commands, name)
        if value is not None:
            raise LimitError(f"{name} takes no value: nothing was sent")
        return self.save(node)

    def save(self, node: int) -> Plan[tuple[str, ...]]:
        """Write the servo's settings to its flash, once. Returns what a person should know of it."""
        notes: tuple[str, ...] = ()
        if self.options.save_reply == "none":
            yield from ask(Tell(self.timing, node, Command.SAVE, SAVE_WORD))
        else:
            try:
                yield from ask(Save(self.timing, node))
            except (ReplyTimeout, DeviceError) as error:
                if self.options.save_reply == "required":
                    raise
                if isinstance(error, DeviceError):
                    notes = (error.message,)
        if node in self.pending:
            self.pending[node] = replace(self.pending[node], saved=not notes)
        return notes

    def restarted(self, node: int) -> Plan[int]:
        """After the servo was switched off and on (and the line set to its new rate): the id it answers to. A change that was not
        saved is lost. Raises ReplyTimeout, DeviceError; the change is pending as before then."""
        change = self.pending.get(node)
        now = change.value if change is not None and change.what == "id" and change.saved else node
        said = yield from ask(self._read_id(now))
        if said != now:
            raise DeviceError(f"id {now} answers, and says its id is {said}: was it restarted?")
        self.pending.pop(node, None)
        return now

    def lone_id(self) -> Plan[int]:
        """The id of the only servo on the line, asked of all. Raises NotSupported where the config does not allow that."""
        return self._ask_all(Broadcast(self.timing, self.options, Command.READ_ID))

    def own_ids(self, node: int) -> tuple[int, ...]:
        """What the servo at this address may say its id is: the seed does not tell whether a new one shows before the restart."""
        change = self.pending.get(node)
        return (node, change.value) if change is not None and change.what == "id" else (node,)

    @staticmethod
    def _ask_all(request: Broadcast) -> Plan[int]:
        answer = yield from ask(request)
        assert answer is not None  # the config waits for it, or does not allow the question
        return answer.address

    def _refuse_second(self, node: int) -> None:
        if node in self.pending:
            raise NotSupported(f"{self.pending[node]}. One change at a time: nothing was sent")

    def _change(self, change: Change, command: Command, value: int, save: bool) -> Plan[Change]:
        immediate = self.options.id_effective == "immediate"
        moves = change.what == "id" and immediate
        if change.what == "id" and change.value != change.node:
            yield from self._expect_silence(change.value)
        suspicion = (yield from look(self.timing, change.node)).suspicion
        if suspicion:
            raise DeviceError(f"{suspicion}. Nothing was changed")
        yield from ask(Confirmed(self.timing, change.node, command, bytes((value,)), also=value if moves else None))
        if immediate:
            change = replace(change, pending_reboot=False)
        else:
            self.pending[change.node] = change
        if not (immediate and change.what == "baudrate"):  # there the line has to follow first
            yield from self._read_back(change, value if moves else change.node)
        if not save:
            return change
        notes = yield from self.save(value if moves else change.node)
        return replace(change, saved=not notes, notes=change.notes + notes)

    def _expect_silence(self, node: int) -> Plan[None]:
        try:
            yield from ask(self._read_id(node))
        except ReplyTimeout:
            return
        raise DeviceError(f"id {node} answers already: choose a free one. Nothing was changed")

    def _read_back(self, change: Change, node: int) -> Plan[None]:
        said = yield from ask(self._read_id(node))
        if said not in (*self.own_ids(node), node):
            raise DeviceError(f"after {change.what} {change.value} was set, the servo says its id is {said}: do not save it")

    def _read_id(self, node: int) -> Read[int]:
        return Read(self.timing, node, Command.READ_ID, lambda data: data[0], once=True)


def _id_notes(new: int) -> Iterator[str]:
    if new == DOUBTFUL_ID:
        yield "id 255 is what a silent line looks like: choose another if you can"
