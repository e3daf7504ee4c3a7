"""Finds out whether servos still are as they were left, before a goal leaves. Pure: it is given the time.

A goal switches torque on. So it must not reach a servo that has restarted, or whose torque a protection has switched off,
since it was enabled. The cases:

1. A reply told it lately (`confirm`): a poll, a read, an earlier verification. The goal leaves at once.
2. Nothing told it for `MAX_AGE`: a job of `Motion.verify` goes first, for all goals of the group at once.
3. That job has just ended: the goal leaves next, even where a slow turn of a lower class came between (`PASS`).
4. A servo is not as it was left: `lost(servo, loss)` is called, which disables it and ends its goals.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial

from servobus.engine.coalescer import Ticket
from servobus.engine.job import Callback, Job
from servobus.protocols.base import Motion
from servobus.values import Loss

MAX_AGE = 0.05
"""Seconds for which a servo counts as verified. A restart that is shorter than this is not noticed before the next goal."""
PASS = 0.25
"""Seconds after which a verification that no goal used is worth no more than any other reply."""


class Verification:
    """When each servo of one bus was last known to be as it was left."""

    __slots__ = ("_driver", "_lost", "_passed", "_verified")

    def __init__(self, driver: Motion, lost: Callable[[str, Loss], None]) -> None:
        self._driver = driver
        self._lost = lost
        self._verified: dict[str, float] = {}
        self._passed: dict[str, float] = {}
        """Servo -> until when it needs no further verification, for one goal."""

    def confirm(self, servo: str, now: float) -> None:
        """Note that a reply showed the servo as it was left."""
        self._verified[servo] = now

    def forget(self, servos: Iterable[str]) -> None:
        """Note that it is not known how these servos are: their node was doubtful."""
        for servo in servos:
            self._verified.pop(servo, None)
            self._passed.pop(servo, None)

    def job(self, tickets: Sequence[Ticket], now: float) -> Job | None:
        """Return the job that must come before these goals; None: they may leave."""
        limit, verified = now - MAX_AGE, self._verified
        stale = [ticket.goal.servo for ticket in tickets if verified.get(ticket.goal.servo, limit) <= limit]
        if not stale:
            return None
        passed = self._passed
        if passed and all(passed.pop(servo, 0.0) > now for servo in stale):
            return None
        plan = self._driver.verify(stale)
        if plan is None:
            return None
        return Job(Callback(partial(self._ended, stale, now + PASS)), now + PASS, plan=plan, node=tickets[0].node)

    def _ended(self, servos: Sequence[str], until: float, result: Mapping[str, Loss] | Exception) -> None:
        if isinstance(result, Exception):
            return  # the servos that did not answer are doubtful now, so their goals wait for a fence
        for servo in servos:
            if servo in result:
                self._lost(servo, result[servo])
            else:
                self._passed[servo] = until
