"""The fence that every protocol shares: which request is chosen, and how often it is tried.

After a lost, late or unexpected reply nobody knows which replies of a node are still under way. A fence is a request whose reply
cannot be confused with any of them: its reply key is not among the keys to avoid. When that reply has arrived, all earlier ones
have arrived too or never will, so the node can be believed again.

A fence that fails may have a late reply of its own, so the next try uses another key. When every key may be under way, the one
that was asked for longest ago is the least likely to arrive still.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Sequence
from typing import TypeVar

from servobus.errors import ServobusError
from servobus.protocols.base import Plan

K = TypeVar("K", bound=Hashable)
R = TypeVar("R")

FENCE_TRIES = 2


def choose_key(keys: Sequence[K], avoid: Sequence[Hashable]) -> K:
    """Return the first of the reply keys that is not in `avoid` (oldest first); when all are, the one that is oldest there."""
    free = (key for key in keys if key not in avoid)
    oldest = (key for used in avoid for key in keys if key == used)
    return next(free, None) or next(oldest)


def fence(
    attempt: Callable[[K], Plan[R]],
    keys: Sequence[K],
    avoid: Sequence[Hashable],
    *,
    after_failure: Iterable[Hashable] = (),
    retry_on: type[ServobusError] = ServobusError,
) -> Plan[R]:
    """Send fences until one is answered, and return what `attempt` returned.

    Args:
        attempt: makes the plan of one fence whose reply has this key.
        keys: the reply keys a fence of this protocol can have, the preferred ones first.
        avoid: the keys of replies that may still be under way, oldest first.
        after_failure: further keys that a failed attempt may leave under way.
        retry_on: the errors after which the next key is tried.

    Raises the error of the last attempt.
    """
    used = list(avoid)
    for _ in range(FENCE_TRIES - 1):
        key = choose_key(keys, used)
        try:
            return (yield from attempt(key))
        except retry_on:
            used += (key, *after_failure)
    return (yield from attempt(choose_key(keys, used)))
