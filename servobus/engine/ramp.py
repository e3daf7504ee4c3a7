"""Speed kept by the host, for servos that have no speed of their own: a goal becomes a ramp of setpoints. Pure.

Such a servo goes to each goal as fast as it can. So on the bus's cycle it is sent a setpoint a little further on, and
never has farther to go than one cycle at the wanted speed. The cases:

1. The caller's ticket carries the first setpoint. The others follow once that one was delivered.
2. A setpoint that fails ends the ramp, and `cut(servo, error)` reports it; the first one's error goes to the caller.
3. A newer goal replaces the ramp and starts at the last setpoint, where the servo is or is going.
4. A cycle that comes late is not caught up with: the next setpoint is one whole period later.

The last setpoint of a servo belongs to its record: `begin` is given it, and `sent(servo, setpoint)` reports each new one.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from functools import partial

from servobus.engine.coalescer import Ticket
from servobus.values import Outcome, ServoGoal


@dataclass(slots=True, eq=False)
class Ramp:
    """The way of one servo from its last setpoint to its goal."""

    goal: ServoGoal
    node: int
    start_within: float
    step: float
    """Units a cycle, signed."""
    setpoint: float
    due: float | None = None
    """When the next setpoint leaves. None: the first was not delivered yet, or the last has left."""


class SetpointRamps:
    """The ramps under way on one bus."""

    def __init__(self, hz: float, cut: Callable[[str, Exception], None], sent: Callable[[str, float], None]) -> None:
        self._period = 1.0 / hz
        self._cut = cut
        self._sent = sent
        self.active: dict[str, Ramp] = {}

    def use_rate(self, hz: float) -> None:
        """Take another rate of setpoints. Ramps under way keep their speed."""
        before, self._period = self._period, 1.0 / hz
        for ramp in self.active.values():
            ramp.step *= self._period / before

    def begin(self, ticket: Ticket, speed: float, start: float | None, now: float) -> None:
        """Ramp this goal's servo from `start` at `speed` (unit/s), instead of to any earlier goal. The ticket then carries the
        first setpoint. A goal without a start is sent as it is."""
        goal = ticket.goal
        if start is None:
            self.drop({ticket.servo})
            return
        step = speed * self._period
        ramp = Ramp(goal, ticket.node, ticket.expires - now, step if goal.goal.value >= start else -step, start)
        self.active[ticket.servo] = ramp
        ticket.goal = _advance(ramp)
        ticket.done = partial(self._first_ended, ramp, now, ticket.done)

    def due(self, now: float) -> list[Ticket]:
        """Return the setpoints of this cycle."""
        tickets = []
        for servo, ramp in self.active.items():
            if ramp.due is not None and ramp.due <= now:
                goal = _advance(ramp)
                last = ramp.setpoint == ramp.goal.goal.value
                following = ramp.due + self._period
                ramp.due = None if last else following if following > now else now + self._period
                tickets.append(Ticket(goal, ramp.node, now + ramp.start_within, partial(self._ended, ramp)))
                self._sent(servo, ramp.setpoint)
        return tickets

    def next_due(self) -> float | None:
        return min((ramp.due for ramp in self.active.values() if ramp.due is not None), default=None)

    def drop(self, servos: Collection[str] | None = None) -> None:
        """End the ramps of these servos, or all."""
        for servo in list(self.active) if servos is None else servos:
            self.active.pop(servo, None)

    def _first_ended(
        self, ramp: Ramp, began: float, done: Callable[[Outcome | Exception], None], result: Outcome | Exception
    ) -> None:
        """The caller's ticket has ended: the other setpoints follow if it was delivered and was not the last."""
        delivered = isinstance(result, Outcome) and result is not Outcome.SUPERSEDED
        if delivered:
            self._sent(ramp.goal.servo, ramp.setpoint)
        if delivered and ramp.setpoint != ramp.goal.goal.value:
            ramp.due = began + self._period
        else:
            self._end(ramp)
        done(result)

    def _ended(self, ramp: Ramp, result: Outcome | Exception) -> None:
        """A later setpoint has ended."""
        if isinstance(result, Exception) and self._end(ramp):
            self._cut(ramp.goal.servo, result)
        elif ramp.due is None:
            self._end(ramp)

    def _end(self, ramp: Ramp) -> bool:
        """Return False if the ramp was replaced or dropped before."""
        if self.active.get(ramp.goal.servo) is not ramp:
            return False
        del self.active[ramp.goal.servo]
        return True


def _advance(ramp: Ramp) -> ServoGoal:
    """Go one cycle on; the last step ends at the goal itself."""
    target = ramp.goal.goal.value
    ramp.setpoint = target if abs(target - ramp.setpoint) <= abs(ramp.step) else ramp.setpoint + ramp.step
    return replace(ramp.goal, goal=replace(ramp.goal.goal, value=ramp.setpoint))
