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

PAUSE = 0.03
"""Seconds between two readings that show whether a servo rests."""
REST = 1
"""Steps by which they may differ: less than a servo travels meanwhile at 7 deg/s."""
ROUNDS = 3
"""How often a servo that still moves is read so."""

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
    return servo.believe(sorted((first, second, third))[1], sure=True)


def rest(settings: RequestSettings, servos: Sequence[CalibratedServo]) -> Plan[dict[CalibratedServo, Readings]]:
    """Return two readings of each servo, with a pause between. They are repeated a few times for one that moves meanwhile."""
    results: dict[CalibratedServo, Readings] = {}
    waiting = list(servos)
    for _ in range(ROUNDS):
        before = yield from _read_all(settings, waiting, results, pause=PAUSE)
        now = yield from _read_all(settings, list(before), results)
        results |= {servo: (before[servo], reading) for servo, reading in now.items()}
        waiting = [servo for servo in now if not rests(results[servo])]
        if not waiting:
            break
    return results


def rests(readings: Readings) -> bool:
    """Return whether these are two readings that agree."""
    return not isinstance(readings, ServobusError) and abs(readings[0] - readings[1]) <= REST


def _read_all(
    settings: RequestSettings,
    servos: Sequence[CalibratedServo],
    failed: dict[CalibratedServo, Readings],
    *,
    pause: float = 0.0,
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
