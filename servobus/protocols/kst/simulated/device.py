"""A simulated KST servo: the device's end of KST RS422, 3.

Where the document is silent: an unknown command, and one for another address, gets no reply. Of broadcasts, only set position is
obeyed, and none is answered. A value out of range is refused with an abort code of 0609. A new id or rate takes effect at a
restart if it was saved, and is lost otherwise. After a restart the servo goes to its default position. Attributes change each of
these at any time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TypeAlias

from servobus.protocols.device import DeviceReply
from servobus.protocols.kst import codec
from servobus.protocols.kst.codec import BAUD_TABLE, BROADCAST, FACTORY_ID, REFUSED, REPLY, VERSION, Command, Frame, encode
from servobus.protocols.kst.model import KstModel
from servobus.protocols.kst.options import KstBus

TOO_HIGH, TOO_LOW, OUT_OF_RANGE = 0x06090031, 0x06090032, 0x06090030
DELAY = 100e-6
"""Seconds from command to reply; the document gives none."""

Answer: TypeAlias = bytes | int | None
"""Data of the reply, an abort code, or None for no reply."""


class KstDevice:
    """One servo on the line."""

    def __init__(
        self,
        model: KstModel,
        servo_id: int = FACTORY_ID,
        *,
        baudrate: int = 512_000,
        position: int = 0,
        baud_table: Mapping[int, int] | None = None,
        version: int = VERSION,
        immediate: bool = False,
    ) -> None:
        self.model, self.version = model, version
        self.node, self.baudrate = servo_id, baudrate
        self.immediate = immediate
        """A new id or rate takes effect at once."""
        self.firmware, self.status_bytes = model.firmware.encode().ljust(4, b"\0"), bytes(2)
        self.position = self.goal = float(position)
        self.speed = model.max_steps_per_second
        self.delay = DELAY
        self.extra_delay = 0.0
        """Seconds by which its replies are too late."""
        self.dead = self.mute = False
        """Dead: it neither receives nor replies. Mute: it obeys, and does not reply."""
        self.ignores_goals = False
        """It confirms a position, and keeps its goal."""
        self.room = (-math.inf, math.inf)
        """The steps between which nothing blocks it."""
        self.refuses: dict[int, int] = {}
        """Command -> abort code with which it refuses."""
        self.answers: dict[int, bytes] = {}
        """Command -> data that it replies instead of the right data."""
        self.sdo_order = "be"
        self.answers_save = self.reads_goal = False
        """It replies to save; and to read position with its goal instead of where it is."""
        self._rates = dict(baud_table or BAUD_TABLE)
        self._new = self._stored = (servo_id, baudrate)
        """Id and rate that were set, and those that were saved."""
        self._moved_at = self._awake = -math.inf

    def handle(self, packet: Frame, now: float) -> Sequence[DeviceReply]:
        """Obey a command; see `protocols.base.Device`."""
        broadcast = packet.address == BROADCAST
        handler = HANDLERS.get(packet.code)
        if handler is None or self.dead or now < self._awake or not (broadcast or packet.address == self.node):
            return ()
        if broadcast and packet.code != Command.SET_POSITION:
            return ()
        self.advance(now)
        address = self.node
        answer = self.refuses.get(packet.code) or handler(self, packet.data)
        if answer is None or broadcast or self.mute:
            return ()
        if isinstance(answer, bytes):
            answer = self.answers.get(packet.code, answer)
        return (DeviceReply(self._reply(address, packet.code, answer), self.delay, late=self.extra_delay),)

    def advance(self, now: float) -> None:
        """Move to where it is at `now`."""
        elapsed, self._moved_at = now - self._moved_at, max(now, self._moved_at)
        if 0 < elapsed < math.inf:
            left = self.goal - self.position
            step = self.speed * elapsed
            self.position = self.goal if abs(left) <= step else self.position + math.copysign(step, left)
            self.position = min(max(self.position, self.room[0]), self.room[1])

    def reboot(self, now: float) -> None:
        """Switch off and on: what was not saved is lost, and the goal is the default position."""
        self.advance(now)
        self._awake = now + self.model.reboot_s
        self._new = self._stored
        self._adopt()
        self.goal = float(self.model.default_position)

    # Commands

    def set_baud(self, data: bytes) -> Answer:
        if data[0] not in self._rates:
            return TOO_HIGH
        self._set(self._new[0], self._rates[data[0]])
        return data[:1]

    def set_id(self, data: bytes) -> Answer:
        if data[0] == BROADCAST:
            return TOO_LOW
        self._set(data[0], self._new[1])
        return data[:1]

    def save(self, data: bytes) -> Answer:
        if data[: len(codec.SAVE_DATA)] != codec.SAVE_DATA:
            return None
        self._stored = self._new
        return b"" if self.answers_save else None

    def read_id(self, data: bytes) -> Answer:
        return bytes((self.node,))

    def set_position(self, data: bytes) -> Answer:
        steps = codec.decode_position(data)
        if not self.model.range[0] <= steps <= self.model.range[1]:
            return OUT_OF_RANGE
        if not self.ignores_goals:
            self.goal = float(steps)
        return data[:2]

    def read_position(self, data: bytes) -> Answer:
        return codec.encode_position(round(self.goal if self.reads_goal else self.position))

    def read_status(self, data: bytes) -> Answer:
        return self.status_bytes

    def read_version(self, data: bytes) -> Answer:
        return self.firmware

    def _set(self, servo_id: int, baudrate: int) -> None:
        self._new = servo_id, baudrate
        if self.immediate:
            self._adopt()

    def _adopt(self) -> None:
        self.node, self.baudrate = self._new

    def _reply(self, address: int, command: int, answer: bytes | int) -> bytes:
        if isinstance(answer, bytes):
            return encode(address, REPLY + command, answer, self.version)
        code = answer.to_bytes(4, "little" if self.sdo_order == "le" else "big")
        return encode(address, REFUSED + command, code, self.version)


HANDLERS: dict[int, Callable[[KstDevice, bytes], Answer]] = {
    Command.SET_BAUD: KstDevice.set_baud,
    Command.SET_ID: KstDevice.set_id,
    Command.SAVE: KstDevice.save,
    Command.READ_ID: KstDevice.read_id,
    Command.SET_POSITION: KstDevice.set_position,
    Command.READ_POSITION: KstDevice.read_position,
    Command.READ_STATUS: KstDevice.read_status,
    Command.READ_VERSION: KstDevice.read_version,
}


def devices(options: KstBus, models: Mapping[str, KstModel]) -> list[KstDevice]:
    """Return the simulated servos of a bus, each at its zero position."""
    result = []
    for servo in options.servos.values():
        model = models[servo.model]
        device = KstDevice(
            model,
            servo.id,
            baudrate=options.baudrate,
            position=round(model.zero if servo.zero is None else servo.zero),
            baud_table=options.baud_table,
            version=options.version_byte,
            immediate=options.id_effective == "immediate",
        )
        device.sdo_order = "le" if options.sdo_order == "le" else "be"
        device.answers_save = options.save_reply == "required"
        result.append(device)
    return result
