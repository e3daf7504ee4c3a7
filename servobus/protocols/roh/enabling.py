"""How a finger is enabled: the host's gate is opened, and the finger stays where it is.

1. Read what its registers hold. What a goal changes later is put back to that.
2. Read twice where it is. A finger that moves is refused.
3. Where its target is somewhere else and nothing blocks it, write where it is: the next goal's speed would let it go there.
4. Where its speed is what a hand starts with, write one less. So a restart shows in that register.

A hand that initialises, or waits for its calibration, refuses 4, and says why.
"""

from __future__ import annotations

from servobus.errors import DeviceError
from servobus.protocols.base import Plan
from servobus.protocols.roh.finger import MAX_SPEED, Finger
from servobus.protocols.roh.goals import write_values
from servobus.protocols.roh.hand import Hand, RegisterValue
from servobus.protocols.roh.positions import Reading, rest, rests

BLOCKED = ("over_current", "force_reached", "stuck")
"""Status names of a finger that does not reach its target."""


def enable(hand: Hand, finger: Finger) -> Plan[float]:
    """Return the plan of an enable; see above. Its value is where the finger is, in its unit. Raises DeviceError."""
    finger.held.targets.clear()
    yield from hand.attach()
    speed, current_limit, status = yield from hand.read_values({finger: ("speed", "current_limit", "status")})
    before, now = (yield from rest(hand, [finger]))[finger]
    if not rests(finger, before, now):
        first, second = (finger.calibration.to_unit(reading.position) for reading in (before, now))
        raise DeviceError(f"it moves, it was read at {first:.4g}, then at {second:.4g}: enable it when it rests")
    blocked = hand.map.status_name(status.raw) in BLOCKED
    changes = _changes(finger, now, speed.raw, blocked=blocked)
    finger.begin(changes.get(finger.target_name, now.target), changes.get("speed", speed.raw), current_limit.raw)
    failed = yield from write_values(hand, [RegisterValue(finger, name, raw) for name, raw in changes.items()])
    if failed:
        finger.held.forget()
        raise failed[finger]
    yield from _read_back(hand, finger, tuple(changes))
    return finger.calibration.to_unit(now.position)


def _changes(finger: Finger, reading: Reading, speed: int, *, blocked: bool) -> dict[str, int]:
    """Return the registers to be written and their raw values."""
    changes = {}
    if not blocked and not finger.near(reading.target, reading.position):
        changes[finger.target_name] = reading.position
    if speed > MAX_SPEED:
        changes["speed"] = MAX_SPEED
    return changes


def _read_back(hand: Hand, finger: Finger, names: tuple[str, ...]) -> Plan[None]:
    """Raise DeviceError where a register does not hold what was written."""
    if not names:
        return
    for value in (yield from hand.read_values({finger: names})):
        if not finger.is_kept(value.name, value.raw):
            finger.held.forget()
            raise DeviceError(f"register {value.name} reads {value.raw} after it was written: the hand did not accept it")
