"""The frames that a rig sent, and the effect on simulated servos."""

from __future__ import annotations

from servobus.protocols.sms.codec import Instruction
from servobus.protocols.sms.simulated.device import SmsDevice
from servobus.rig.local import LocalRig

TORQUE, GOAL = "torque_enable", "goal_position"


class WireLog:
    """A trace that keeps the frames that were sent."""

    def __init__(self) -> None:
        self.sent_frames: list[bytes] = []

    def __call__(self, bus: str, sent: bool, data: bytes, time: float) -> None:
        if sent:
            self.sent_frames.append(data)

    def instructions(self) -> set[Instruction]:
        return {Instruction(frame[4]) for frame in self.sent_frames}


def frames(rig: LocalRig, bus: str = "arm") -> int:
    """Return how many frames were sent so far."""
    return int(rig.stats()[bus]["frames"])


def energised(device: SmsDevice) -> bool:
    return device.get(TORQUE) == 1
