"""Finds out whether servos still are as they were left, before a goal leaves. Pure: it is given the time.

A goal switches torque on. So it must not reach a servo that has restarted, or whose torque a protection has switched off,
since it was enabled. The cases:

1. A reply told it lately (`confirm`): a poll, a read, an earlier verification. The goal leaves at once.
2. Nothing told it for `max_age`: a job of `Motion.verify` goes first, for all goals of the group at once. On a slow line that
   takes long, so `max_age` grows with it: verification never takes more than a fifth of the line's time.
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

MIN_AGE, MAX_AGE = 0.004, 0.2
"""Bounds of `max_age`, in seconds."""
COST = 5
"""How many times as long as it took a verification is worth something."""
PASS = 0.25
"""Seconds after which a verification that no goal used is worth no more than any other reply."""


class Verification:
    """When each servo of one bus was last known to be as it was left."""

    __slots__ = ("_asked_at", "_driver", "_lost", "_passed", "_verified", "max_age")

    def __init__(self, driver: Motion, lost: Callable[[str, Loss], None]) -> None:
        self._driver = driver
        self._lost = lost
        self.max_age = MIN_AGE
        """Seconds for which a servo counts as verified: a restart or a loss of torque is noticed by the next goal after them."""
        self._asked_at = 0.0
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
        verified, limit = self._verified, now - self.max_age
        if all([verified.get(ticket.goal.servo, limit) > limit for ticket in tickets]):  # noqa: C419 - a list is faster
            return None
        passed = self._passed
        if passed and all([passed.pop(ticket.goal.servo, 0.0) > now for ticket in tickets]):  # noqa: C419 - it pops each
            self.max_age = min(max(MIN_AGE, COST * (now - self._asked_at)), MAX_AGE)
            verified.update(dict.fromkeys([ticket.goal.servo for ticket in tickets], self._asked_at))
            return None
        servos = [ticket.goal.servo for ticket in tickets]
        plan = self._driver.verify(servos)
        if plan is None:
            return None
        self._asked_at = now
        return Job(Callback(partial(self._ended, servos, now + PASS)), now + PASS, plan=plan, node=tickets[0].node)

    def _ended(self, servos: Sequence[str], until: float, result: Mapping[str, Loss] | Exception) -> None:
        if isinstance(result, Exception):
            return  # the servos that did not answer are doubtful now, so their goals wait for a fence
        for servo in servos:
            if servo in result:
                self._lost(servo, result[servo])
            else:
                self._passed[servo] = until
