"""What was said on a line, and what became of the servos there."""

from __future__ import annotations

from servobus.protocols.sms.codec import Instruction
from servobus.protocols.sms.simulated.device import SmsDevice
from servobus.rig.local import LocalRig

TORQUE, GOAL = "torque_enable", "goal_position"


class WireLog:
    """Keeps the frames that were said."""

    def __init__(self) -> None:
        self.said: list[bytes] = []

    def __call__(self, bus: str, sent: bool, data: bytes, time: float) -> None:
        if sent:
            self.said.append(data)

    def instructions(self) -> set[Instruction]:
        return {Instruction(frame[4]) for frame in self.said}


def frames(rig: LocalRig, bus: str = "arm") -> int:
    """How many frames were said so far."""
    return int(rig.stats()[bus]["frames"])


def energised(device: SmsDevice) -> bool:
    return device.get(TORQUE) == 1
