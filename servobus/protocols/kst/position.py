"""Where a servo is, and whether it rests: readings that one altered reply cannot falsify.

A frame has an 8-bit sum, so an altered position can look valid. A reading that is where the servo can be is believed. Any other
is read again: two readings that agree count, else the middle one of three. A servo rests where two readings agree between which
the line was silent for a while.
"""

from __future__ import annotations

from collections.abc import Sequence

from servobus.errors import ServobusError
from servobus.protocols.base import Plan, ask
from servobus.protocols.kst.codec import Command, decode_position
from servobus.protocols.kst.requests import Read, RequestSettings
from servobus.protocols.kst.servo import CalibratedServo
from servobus.protocols.rest import middle, read_twice

REST = 1
"""Steps by which two readings of a servo at rest may differ: less than it travels meanwhile at 7 deg/s."""

Readings = tuple[int, int] | ServobusError
"""The last two readings of a servo in steps, or why it could not be read."""


def position_read(settings: RequestSettings, servo: CalibratedServo, *, once: bool = False) -> Read[int]:
    """Return a read of the position in steps, from which nothing is concluded yet."""
    return Read(settings, servo.node, Command.READ_POSITION, decode_position, once=once)


def locate(settings: RequestSettings, servo: CalibratedServo, *, once: bool = False) -> Plan[int]:
    """Return where the servo is, in steps. Raises DeviceError for a position that this model cannot have.

    `once`: no read is repeated, because nothing would tell the reply to the repetition from that to the first.
    """
    request = position_read(settings, servo, once=once)
    first = yield from ask(request)
    if servo.travel.expects(first):
        return servo.believe(first)
    second = yield from ask(request)
    if abs(first - second) <= servo.travel.jitter:
        return servo.believe(second, sure=True)
    third = yield from ask(request)
    return servo.believe(middle(first, second, third), sure=True)


def rest(settings: RequestSettings, servos: Sequence[CalibratedServo]) -> Plan[dict[CalibratedServo, Readings]]:
    """Return two readings of each servo, see `protocols.rest`, or why it could not be read."""
    failed: dict[CalibratedServo, Readings] = {}

    def read(some: Sequence[CalibratedServo], pause: float) -> Plan[dict[CalibratedServo, int]]:
        return _read_all(settings, some, failed, pause)

    twice = yield from read_twice(servos, read, lambda _, before, now: rests((before, now)))
    return {**twice, **failed}


def rests(readings: Readings) -> bool:
    """Return whether these are two readings that agree."""
    return not isinstance(readings, ServobusError) and abs(readings[0] - readings[1]) <= REST


def _read_all(
    settings: RequestSettings,
    servos: Sequence[CalibratedServo],
    failed: dict[CalibratedServo, Readings],
    pause: float,
) -> Plan[dict[CalibratedServo, int]]:
    """Read each servo. `pause`: seconds of silence after the last one."""
    readings: dict[CalibratedServo, int] = {}
    for servo in servos:
        request = position_read(settings, servo)
        if servo is servos[-1]:
            request.quiet_after = max(request.quiet_after, pause)
        try:
            readings[servo] = yield from ask(request)
        except ServobusError as error:
            failed[servo] = error
    return readings
