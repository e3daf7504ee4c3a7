"""Speed kept by the host, for servos that have no speed of their own: a goal becomes a ramp of setpoints. Pure.

Such a servo goes to each goal as fast as it can. So on the bus's cycle it is sent a setpoint a little further on, and
never has farther to go than one cycle at the wanted speed. The cases:

1. The caller's ticket carries the first setpoint. The others follow once that one was delivered.
2. One setpoint is under way at a time. The next one is made when it has ended, so none is superseded by the next: while a
   servo does not answer, its ramp waits.
3. Each setpoint has a `lead`: the driver reads the servo and sends at most one step ahead of that. Where it sent less, the
   ramp goes on from there.
4. A setpoint that fails or is superseded ends the ramp, and so does its node when it goes offline. `cut(servo, error)` reports
   it; the error of the first setpoint goes to the caller instead.
5. A newer goal replaces the ramp and starts at the last setpoint, where the servo is or is going. Its first step is shorter where
   that setpoint is less than a cycle old: a stream of goals is no faster than one goal.
6. A cycle that comes late is not caught up with: the next setpoint is one whole period later.

The last setpoint of a servo belongs to its record: `begin` is given it, and `sent(servo, setpoint)` reports each one that was
delivered.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from functools import partial

from servobus.engine.coalescer import Ticket
from servobus.errors import GoalExpired
from servobus.values import Outcome, ServoGoal

REPLACED = "a setpoint on the way to its goal was replaced before it could leave"


@dataclass(slots=True, eq=False)
class Ramp:
    """The way of one servo from its last setpoint to its goal."""

    goal: ServoGoal
    node: int
    start_within: float
    step: float
    """Units a cycle."""
    setpoint: float
    """The last one that was delivered; before the first, where the ramp starts."""
    due: float
    """When the next setpoint leaves."""
    made_at: float
    """When the last setpoint was made."""
    under_way: bool = True
    """A setpoint was made that has not ended."""
    begun: bool = False
    """The first setpoint was delivered."""

    def advance(self, share: float = 1.0) -> ServoGoal:
        """Return the next setpoint, one cycle or a share of it on; the last one is the goal itself."""
        target = self.goal.goal.value
        left, step = target - self.setpoint, share * self.step
        value = target if abs(left) <= step else self.setpoint + math.copysign(step, left)
        return replace(self.goal, goal=replace(self.goal.goal, value=value), lead=self.step, applied=None, packed=None)

    def delivered(self, setpoint: ServoGoal) -> bool:
        """Note that a setpoint was delivered; return whether it was the last."""
        self.begun, self.under_way = True, False
        self.setpoint = setpoint.goal.value if setpoint.applied is None else setpoint.applied
        return setpoint.applied is None and self.setpoint == self.goal.goal.value


class SetpointRamps:
    """The ramps under way on one bus."""

    def __init__(self, hz: float, cut: Callable[[str, Exception], None], sent: Callable[[str, float], None]) -> None:
        self._period = 1.0 / hz
        self._cut = cut
        self._sent = sent
        self.active: dict[str, Ramp] = {}
        self._made_at: dict[str, float] = {}
        """Servo -> when its last setpoint was made that was delivered."""

    def use_rate(self, hz: float) -> None:
        """Take another rate of setpoints. Ramps under way keep their speed."""
        before, self._period = self._period, 1.0 / hz
        for ramp in self.active.values():
            ramp.step *= self._period / before

    def begin(self, ticket: Ticket, speed: float, start: float | None, now: float) -> None:
        """Ramp this goal's servo from `start` at `speed` (unit/s), instead of to any earlier goal.

        The ticket then carries the first setpoint. Without a setpoint to start at, the ramp starts where the goal starts.
        """
        goal = ticket.goal
        start = goal.start if start is None else start
        assert start is not None, "a driver that asks for a ramp refuses a goal without a start"
        ramp = Ramp(goal, ticket.node, ticket.expires - now, speed * self._period, start, now + self._period, now)
        self.active[ticket.servo] = ramp
        before = self._made_at.get(ticket.servo, -math.inf)
        ticket.goal = ramp.advance(min(1.0, (now - before) / self._period))
        ticket.done = partial(self._first_ended, ramp, ticket.goal, ticket.done)

    def due(self, now: float) -> list[Ticket]:
        """Return the setpoints of this cycle."""
        tickets = []
        for ramp in self.active.values():
            if not ramp.under_way and ramp.due <= now:
                following = ramp.due + self._period
                ramp.due = following if following > now else now + self._period
                ramp.under_way, ramp.made_at = True, now
                goal = ramp.advance()
                ended, gone = partial(self._ended, ramp, goal), partial(self._is_gone, ramp)
                tickets.append(Ticket(goal, ramp.node, now + ramp.start_within, ended, gone=gone))
        return tickets

    def next_due(self) -> float | None:
        return min((ramp.due for ramp in self.active.values() if not ramp.under_way), default=None)

    def drop(self, servos: Collection[str] | None = None) -> None:
        """End the ramps of these servos, or all."""
        for servo in list(self.active) if servos is None else servos:
            self.active.pop(servo, None)

    def end_node(self, node: int, error: Exception) -> None:
        """End the ramps of a node that went offline. One that has not begun is left to its ticket, which expires."""
        for ramp in [ramp for ramp in self.active.values() if ramp.node == node and ramp.begun]:
            self._end(ramp)
            self._cut(ramp.goal.servo, error)

    def _first_ended(
        self, ramp: Ramp, setpoint: ServoGoal, done: Callable[[Outcome | Exception], None], result: Outcome | Exception
    ) -> None:
        """The caller's ticket has ended: the other setpoints follow if it was delivered and was not the last."""
        if not isinstance(result, Outcome) or result is Outcome.SUPERSEDED or self._deliver(ramp, setpoint):
            self._end(ramp)
        done(result)

    def _ended(self, ramp: Ramp, setpoint: ServoGoal, result: Outcome | Exception) -> None:
        """A later setpoint has ended."""
        if isinstance(result, Outcome) and result is not Outcome.SUPERSEDED:
            if self._deliver(ramp, setpoint):
                self._end(ramp)
        elif not self._is_gone(ramp):
            self._end(ramp)
            self._cut(ramp.goal.servo, result if isinstance(result, Exception) else GoalExpired(REPLACED))

    def _deliver(self, ramp: Ramp, setpoint: ServoGoal) -> bool:
        last = ramp.delivered(setpoint)
        self._made_at[ramp.goal.servo] = ramp.made_at
        self._sent(ramp.goal.servo, ramp.setpoint)
        return last

    def _is_gone(self, ramp: Ramp) -> bool:
        """Return whether the ramp was replaced, dropped or has ended."""
        return self.active.get(ramp.goal.servo) is not ramp

    def _end(self, ramp: Ramp) -> None:
        if not self._is_gone(ramp):
            del self.active[ramp.goal.servo]
