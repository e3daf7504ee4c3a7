"""Whether a joint rests, for protocols whose status does not tell it: two readings with a pause between.

A reply may be altered in a way that its sum does not show. So one reading that surprises is read again: two that agree count,
else the middle one of three.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

from servobus.protocols.base import Plan

S = TypeVar("S")
R = TypeVar("R")

PAUSE = 0.03
"""Seconds of silence between the two readings."""
ROUNDS = 3
"""How often a joint that still moves is read so."""


def read_twice(
    servos: Sequence[S], read: Callable[[Sequence[S], float], Plan[dict[S, R]]], rests: Callable[[S, R, R], bool]
) -> Plan[dict[S, tuple[R, R]]]:
    """Return two readings of each servo. They are repeated a few times for those that move meanwhile.

    Args:
        read: makes the plan that reads these servos, and lets so many seconds of silence follow. It leaves out a servo that
            cannot be read.
        rests: returns whether two readings of a servo agree.
    """
    results: dict[S, tuple[R, R]] = {}
    waiting = servos
    for _ in range(ROUNDS):
        before = yield from read(waiting, PAUSE)
        now = yield from read(list(before), 0.0)
        results |= {servo: (before[servo], reading) for servo, reading in now.items()}
        waiting = [servo for servo in now if not rests(servo, *results[servo])]
        if not waiting:
            break
    return results


def middle(first: int, second: int, third: int) -> int:
    """Return the reading that lies between the two others."""
    return sorted((first, second, third))[1]
