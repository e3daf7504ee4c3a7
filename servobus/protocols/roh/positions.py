"""Where fingers are, and whether they rest: several readings, because one may be wrong or old.

A finger rests where two readings agree between which the line was silent for a while. Its status register is not used for that:
what it says while a finger is blocked or holds something is not documented.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from servobus.protocols.base import Plan
from servobus.protocols.rest import middle, read_twice
from servobus.protocols.roh.finger import Finger
from servobus.protocols.roh.hand import Hand

REST_STEPS = 1.0
"""Steps of a finger (0.1 % or 0.1 degrees) by which two readings of one at rest may differ."""
CLOSE_STEPS = 50.0
"""Steps by which two readings of a finger that moves may differ, one turn apart."""


@dataclass(frozen=True, slots=True)
class Reading:
    """What a finger's registers hold, as raw values."""

    target: int
    position: int


def read_fingers(hand: Hand, fingers: Sequence[Finger], *, pause: float = 0.0) -> Plan[dict[Finger, Reading]]:
    """Read targets and positions. `pause`: seconds of silence after them."""
    names = {finger: (finger.target_name, finger.position_name) for finger in fingers}
    values = iter((yield from hand.read_values(names, pause=pause)))
    return {target.finger: Reading(target.raw, position.raw) for target, position in zip(values, values, strict=True)}


def locate(hand: Hand, expected: Mapping[Finger, int | None]) -> Plan[dict[Finger, int]]:
    """Return where the fingers are, as raw values.

    One reading is believed where it is near what is expected. Else two that are close to each other count, and the middle one of
    three where they are not.
    """
    fingers = list(expected)
    first = yield from read_fingers(hand, fingers)
    places = [{finger: reading.position for finger, reading in first.items()}]
    if all(_is_close(finger, expected[finger], places[0][finger]) for finger in fingers):
        return places[0]
    second = yield from read_fingers(hand, fingers)
    places.append({finger: reading.position for finger, reading in second.items()})
    if all(_is_close(finger, places[0][finger], places[1][finger]) for finger in fingers):
        return places[1]
    third = yield from read_fingers(hand, fingers)
    places.append({finger: reading.position for finger, reading in third.items()})
    return {finger: middle(*(each[finger] for each in places)) for finger in fingers}


def _is_close(finger: Finger, expected: int | None, position: int) -> bool:
    return expected is not None and finger.near(expected, position, CLOSE_STEPS)


def rest(hand: Hand, fingers: Collection[Finger]) -> Plan[dict[Finger, tuple[Reading, Reading]]]:
    """Return two readings of each finger, see `protocols.rest`."""

    def read(some: Sequence[Finger], pause: float) -> Plan[dict[Finger, Reading]]:
        return read_fingers(hand, some, pause=pause)

    return (yield from read_twice(list(fingers), read, rests))


def rests(finger: Finger, before: Reading, now: Reading) -> bool:
    return finger.near(before.position, now.position, REST_STEPS)
