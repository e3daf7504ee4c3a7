"""Simulated servos in every mode, as another program may have left them."""

from __future__ import annotations

from servobus.protocols.sms.simulated.device import SmsDevice
from tests.protocols.sms.bench import Bench

FAMILIES = ("sts", "sms", "sms_cl", "scs")
MODES = [
    *[(family, mode) for family in ("sts", "sms", "sms_cl") for mode in ("position", "velocity", "pwm")],
    ("sts", "step"),
    ("sms", "step"),
    ("scs", "position"),
    ("scs", "motor"),
]
"""Family, mode."""
MODE_NUMBERS = {"position": 0, "velocity": 1, "pwm": 2, "step": 3}


def put(device: SmsDevice, name: str, raw: int, now: float = 0.0) -> None:
    """Somebody else writes a register."""
    register = device.memory.registers[name]
    device.memory.store(register, raw)
    device.apply(register.address, device.memory.read(register.address, register.size), now)


def set_mode(device: SmsDevice, mode: str) -> None:
    """Put the servo into a mode; its torque stays as it is."""
    if mode == "motor":
        put(device, "min_angle_limit", 0)
        put(device, "max_angle_limit", 0)
    elif "mode" in device.model.registers:
        put(device, "mode", MODE_NUMBERS[mode])


def moving(bench: Bench, mode: str, node: int = 1) -> SmsDevice:
    """Another program has put the servo into a mode, and it moves."""
    device = bench.devices[node]
    set_mode(device, mode)
    if mode in ("position", "step"):
        put(device, "goal_speed", 100)
        put(device, "goal_position", 900)
    put(device, device.model.torque, 1)
    if mode == "velocity":
        put(device, "goal_speed", 100)
    if mode in ("pwm", "motor"):
        put(device, "goal_time", 100)
    assert device.joint.velocity != 0
    return device


def travel(bench: Bench, device: SmsDevice, seconds: float = 10.0) -> float:
    """Return how far the joint goes from now on."""
    device.joint.advance(bench.now)
    before = device.joint.position
    bench.now += seconds
    device.joint.advance(bench.now)
    return abs(device.joint.position - before)
