"""A simulated ROH hand on its line: the device's end of ROH Modbus, 3.

Where the documents are silent: a write of several registers stops at the first that is refused, and those before it are written.
Broadcasts are obeyed and not answered. A new unit takes effect after the reply and a restart. Attributes change each of these at
any time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

from servobus.protocols.device import DeviceReply
from servobus.protocols.modbus.codec import BROADCAST, MAX_READ, REFUSED, Frame, Function, encode, pack, unpack
from servobus.protocols.roh.model import NEWEST, RohModel
from servobus.protocols.roh.options import RohBus
from servobus.protocols.roh.simulated.hand import Refusal, SimulatedHand

DELAY = 0.002
"""Seconds from request to reply; no document gives one."""
ILLEGAL_FUNCTION, ILLEGAL_VALUE = 1, 3


class RohDevice(SimulatedHand):
    """One hand on the line."""

    def __init__(self, model: RohModel, unit: int = 2, *, baudrate: int = 115_200) -> None:
        super().__init__(model, unit)
        self.baudrate = baudrate
        self.delay = DELAY
        self.extra_delay = 0.0
        """Seconds by which its replies are too late."""
        self._due = -math.inf
        self.dead = False
        """It neither receives nor replies."""
        self.obeys_broadcasts = True
        self.answers_broadcasts = False
        self.answers_restart = True
        """It replies to the write that makes it restart."""
        self.max_registers = MAX_READ

    def handle(self, packet: Frame, now: float) -> Sequence[DeviceReply]:
        """Obey a request; see `protocols.base.Device`."""
        broadcast = packet.unit == BROADCAST
        if not (broadcast or packet.unit == self.node) or self.dead or now < self._awake or self.state == "update":
            return ()
        if broadcast and (not self.obeys_broadcasts or packet.function == Function.READ_HOLDING):
            return ()
        self.advance(now)
        unit, awake = self.node, self._awake
        try:
            reply = encode(unit, packet.function, self._obey(packet))
        except Refusal as refusal:
            if refusal.sub:
                self.poke("sub_exception", 0, refusal.sub)
            reply = encode(unit, packet.function | REFUSED, bytes((refusal.code,)))
        restarted = self._awake != awake or self.state == "update"
        if (broadcast and not self.answers_broadcasts) or (restarted and not self.answers_restart):
            return ()
        # In order: a late reply is not overtaken by the next.
        self._due = max(self._due, now + self.extra_delay)
        return (DeviceReply(reply, self.delay, late=self._due - now),)

    # Requests

    def _obey(self, packet: Frame) -> bytes:
        handler = HANDLERS.get(packet.function)
        if handler is None:
            raise Refusal(ILLEGAL_FUNCTION)
        return handler(self, packet.data)

    def read(self, data: bytes) -> bytes:
        address, count = unpack(data)
        self._require_count(count)
        registers = pack([self.read_word(each) for each in range(address, address + count)])
        return bytes((len(registers),)) + registers

    def write_single(self, data: bytes) -> bytes:
        address, word = unpack(data)
        self.write_word(address, word)
        return data

    def write_multiple(self, data: bytes) -> bytes:
        address, count = unpack(data[:4])
        self._require_count(count)
        for each, word in enumerate(unpack(data[5:]), address):
            self.write_word(each, word)
        return data[:4]

    def _require_count(self, count: int) -> None:
        if not 1 <= count <= self.max_registers:
            raise Refusal(ILLEGAL_VALUE)


HANDLERS: dict[int, Callable[[RohDevice, bytes], bytes]] = {
    Function.READ_HOLDING: RohDevice.read,
    Function.WRITE_SINGLE: RohDevice.write_single,
    Function.WRITE_MULTIPLE: RohDevice.write_multiple,
}


def devices(options: RohBus, models: Mapping[str, RohModel]) -> list[RohDevice]:
    """Return the simulated hands of a line, with open fingers. A hand whose map is not pinned has the newest."""
    units = dict.fromkeys(servo.id for servo in options.servos.values())
    maps = {unit: options.map_of(unit) for unit in units}
    return [RohDevice(models[NEWEST if name == "auto" else name], unit, baudrate=options.baudrate) for unit, name in maps.items()]
