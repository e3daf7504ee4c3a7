"""A simulated FEETECH servo: the other end of SMS 1.0 (1.1 to 1.4), on the same model file as the driver.

The table `VERBS` maps each instruction to what the servo does; the tables of the codec decide whether it answers. Where the
documents are silent: a packet that is malformed, unknown, or (SYNC READ) not supported by this model gets no reply; READ beyond
address 255 gets the bytes that exist; an id or a baud rate takes effect at once, so the reply to an id write has the new id, and
the line still sends the reply to a baud rate write at the old rate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TypeAlias

from servobus.protocols.device import DeviceReply
from servobus.protocols.sms.codec import ANSWERED_BROADCASTS, BROADCAST_ID, WRITES, Instruction, Packet, encode
from servobus.protocols.sms.model import SmsModel
from servobus.protocols.sms.options import SmsBus
from servobus.protocols.sms.simulated.servo import SimulatedServo

SHORTEST_DELAY = 50
"""A return delay below this, but not 0, acts as this (units of 2 us; FEETECH memory table, address 7)."""

REBOOT = 0x08
"""An instruction newer than SMS 1.0, which is never answered."""

Answer: TypeAlias = tuple[int, bytes] | None
"""Slot among the replies, and parameters; None: no reply."""


class SmsDevice(SimulatedServo):
    """One servo on the line. `dead` and `extra_delay` may be set at any time."""

    def __init__(
        self, model: SmsModel, servo_id: int, *, baudrate: int, position: int | None = None, response_level: int = 1
    ) -> None:
        super().__init__(model, servo_id, baudrate=baudrate, position=position, response_level=response_level)
        self.dead = False
        """It neither receives nor sends."""
        self.extra_delay = 0.0
        """Seconds by which its replies are late."""
        self._armed: tuple[int, bytes] | None = None
        self._awake = -math.inf

    def handle(self, packet: Packet, now: float) -> Sequence[DeviceReply]:
        """Carry out a packet, and answer it where the protocol demands a reply."""
        everybody = packet.id == BROADCAST_ID
        if not (everybody or packet.id == self.node) or self.dead or now < self._awake:
            return ()
        verb = VERBS.get(packet.code)
        answer = verb(self, packet, now) if verb else None
        if answer is None or (everybody and packet.code not in ANSWERED_BROADCASTS):
            return ()
        if packet.code in WRITES and not self.get("response_status_level"):
            return ()
        slot, params = answer
        return (DeviceReply(encode(self.node, self.faults, params), self._delay(), slot, self.extra_delay),)

    def reboot(self, now: float) -> None:
        """Restart; it does not answer meanwhile."""
        self._awake = now + self.model.reboot_s
        self._armed = None
        self.restart(now)

    # Instructions

    def ping(self, packet: Packet, now: float) -> Answer:
        """To the broadcast id, newer servos answer one after another by id, and clients rely on it. Older ones collide."""
        in_turn = self.model.sync_read and packet.id == BROADCAST_ID
        return self.node if in_turn else 0, b""

    def read(self, packet: Packet, now: float) -> Answer:
        if len(packet.params) != 2:
            return None
        return 0, self.read_table(packet.params[0], packet.params[1], now)

    def write(self, packet: Packet, now: float) -> Answer:
        if len(packet.params) < 2:
            return None
        self.apply(packet.params[0], packet.params[1:], now)
        return 0, b""

    def reg_write(self, packet: Packet, now: float) -> Answer:
        if len(packet.params) < 2:
            return None
        self._arm((packet.params[0], packet.params[1:]))
        return 0, b""

    def action(self, packet: Packet, now: float) -> Answer:
        armed = self._armed
        self._arm(None)
        if armed:
            self.apply(*armed, now)
        return 0, b""

    def factory(self, packet: Packet, now: float) -> Answer:
        self.reset(now)
        return 0, b""

    def power_cycle(self, packet: Packet, now: float) -> Answer:
        self.reboot(now)
        return None

    def sync_write(self, packet: Packet, now: float) -> Answer:
        """Carry out this servo's part of the packet, which must have a whole number of parts."""
        params = packet.params
        if len(params) >= 2 and packet.id == BROADCAST_ID and (len(params) - 2) % (params[1] + 1) == 0:
            step = params[1] + 1
            for at in range(2, len(params), step):
                if params[at] == self.node:
                    self.apply(params[0], params[at + 1 : at + step], now)
        return None

    def sync_read(self, packet: Packet, now: float) -> Answer:
        slot = packet.params.find(self.node, 2)
        if not self.model.sync_read or packet.id != BROADCAST_ID or slot < 0:
            return None
        return slot - 2, self.read_table(packet.params[0], packet.params[1], now)

    def _arm(self, armed: tuple[int, bytes] | None) -> None:
        """Keep the write that ACTION will carry out, and set the flag register."""
        self._armed = armed
        self.memory.put(self.memory.registers["async_write_flag"], int(armed is not None))

    def _delay(self) -> float:
        delay = self.get("return_delay")
        return max(SHORTEST_DELAY, delay) * 2e-6 if delay else 0.0


VERBS: dict[int, Callable[[SmsDevice, Packet, float], Answer]] = {
    Instruction.PING: SmsDevice.ping,
    Instruction.READ: SmsDevice.read,
    Instruction.WRITE: SmsDevice.write,
    Instruction.REG_WRITE: SmsDevice.reg_write,
    Instruction.ACTION: SmsDevice.action,
    Instruction.RESET: SmsDevice.factory,
    REBOOT: SmsDevice.power_cycle,
    Instruction.SYNC_READ: SmsDevice.sync_read,
    Instruction.SYNC_WRITE: SmsDevice.sync_write,
}


def devices(options: SmsBus, models: Mapping[str, SmsModel]) -> list[SmsDevice]:
    """Return the servos of a bus, each at its zero, which is its middle unless the config has another."""
    level = 1 if options.status_return == "all" else 0
    return [
        SmsDevice(
            models[servo.model],
            servo.id,
            baudrate=options.baudrate,
            position=None if servo.zero is None else round(servo.zero),
            response_level=level,
        )
        for servo in options.servos.values()
    ]
