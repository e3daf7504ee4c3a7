"""A simulated FEETECH servo: seed 1.1 to 1.4 from the other end of the line, on the same model file as the driver.

What it does with an instruction is the table `VERBS`; whether that is answered follows the tables of the codec. What the
documents leave open: a packet that is malformed, unknown, or (SYNC READ) not of this model gets no answer; READ past address 255
gets what exists; an id or a baud rate takes effect at once, so that the answer to an id write carries the new id (feetech.md,
section 9), and the line sends the answer to a baud write still at the old rate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TypeAlias

from servobus.protocols.base import DeviceReply
from servobus.protocols.sms.codec import ANSWERED_BROADCASTS, BROADCAST_ID, WRITES, Instruction, Packet, encode
from servobus.protocols.sms.model import SmsModel
from servobus.protocols.sms.options import SmsBus
from servobus.protocols.sms.simulated.servo import SimulatedServo

SHORTEST_DELAY = 50
"""A return delay below this, but not 0, acts as this (units of 2 us; feetech.md, section 2)."""

REBOOT = 0x08
"""Newer than the seed, and never answered (feetech.md, section 4)."""

Answer: TypeAlias = tuple[int, bytes] | None
"""Place among the answers, and parameters; None: silence."""


class SmsDevice(SimulatedServo):
    """One servo on the line. `dead` and `extra_delay` may be set at any time."""

    def __init__(
        self, model: SmsModel, servo_id: int, *, baudrate: int, position: int | None = None, response_level: int = 1
    ) -> None:
        super().__init__(model, servo_id, baudrate=baudrate, position=position, response_level=response_level)
        self.dead = False
        """Hears and says nothing."""
        self.extra_delay = 0.0
        """Seconds that its answers come too late."""
        self._armed: tuple[int, bytes] | None = None
        self._awake = -math.inf

    def handle(self, packet: Packet, now: float) -> Sequence[DeviceReply]:
        """Obey a packet, and answer it where the rules of the protocol say so."""
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
        """Restart, and be silent meanwhile."""
        self._awake = now + self.model.reboot_s
        self._armed = None
        self.restart(now)

    # Instructions

    def ping(self, packet: Packet, now: float) -> Answer:
        """Asked all at once, newer servos answer one after another by id: clients count on it. Older ones all speak at once."""
        in_turn = self.model.sync_read and packet.id == BROADCAST_ID
        return self.node if in_turn else 0, b""

    def read(self, packet: Packet, now: float) -> Answer:
        if len(packet.params) != 2:
            return None
        return 0, self.look(packet.params[0], packet.params[1], now)

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
        """Its own part of the packet, which has a whole number of parts."""
        params = packet.params
        if len(params) >= 2 and packet.id == BROADCAST_ID and (len(params) - 2) % (params[1] + 1) == 0:
            step = params[1] + 1
            for at in range(2, len(params), step):
                if params[at] == self.node:
                    self.apply(params[0], params[at + 1 : at + step], now)
        return None

    def sync_read(self, packet: Packet, now: float) -> Answer:
        place = packet.params.find(self.node, 2)
        if not self.model.sync_read or packet.id != BROADCAST_ID or place < 0:
            return None
        return place - 2, self.look(packet.params[0], packet.params[1], now)

    def _arm(self, armed: tuple[int, bytes] | None) -> None:
        """Keep what ACTION shall apply; the flag register tells."""
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
    """The servos of a bus, each standing at its zero, which is its middle unless the config says otherwise."""
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
