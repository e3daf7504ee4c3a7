"""How a finger is enabled: the host's gate is opened, and the finger stays where it is.

1. Read what its registers hold. What a goal changes later is put back to that.
2. Read twice where it is. A finger that moves is refused.
3. Where its target is somewhere else and nothing blocks it, write where it is: another speed would let it go there.
4. Write the speed of goals that name none, unless it is there already. That is never the speed that a hand starts with, so a
   restart shows in that register.

A hand that initialises, or waits for its calibration, refuses to be written to, and says why.
"""

from __future__ import annotations

from servobus.errors import DeviceError, ServobusError
from servobus.protocols.base import Plan
from servobus.protocols.roh.finger import Finger
from servobus.protocols.roh.goals import write_values
from servobus.protocols.roh.hand import Hand, RegisterValue
from servobus.protocols.roh.positions import rest, rests

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
    finger.begin(now.target, speed.raw, current_limit.raw)
    blocked = hand.map.status_name(status.raw) in BLOCKED
    if not blocked and not finger.near(now.target, now.position):
        yield from _write(hand, RegisterValue(finger, finger.target_name, now.position))
    wanted = finger.default_speed(hand.map)
    if speed.raw != wanted:
        yield from _write(hand, RegisterValue(finger, "speed", wanted))
    return finger.calibration.to_unit(now.position)


def _write(hand: Hand, value: RegisterValue) -> Plan[None]:
    """Write a register and read it back. Where that fails, the finger counts as never enabled."""
    failed = yield from write_values(hand, [value])
    error: ServobusError | None = failed.get(value.finger)
    if error is None:
        (reading,) = yield from hand.read_values({value.finger: (value.name,)})
        if value.finger.is_kept(reading.name, reading.raw):
            return
        error = DeviceError(f"register {reading.name} reads {reading.raw} after {value.raw} was written: the hand refuses it")
    value.finger.held.forget()
    raise error
