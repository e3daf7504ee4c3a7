"""Speed by the host, for servos that have no speed of their own: a goal becomes a row of setpoints. Pure: the time is given.

A servo that goes to each goal as fast as it can is led there: on the bus's cycle it is sent a setpoint a little further on, so
it never has farther to go than one cycle's way at the wanted speed. The caller's ticket is the first setpoint's; a setpoint
that fails ends the row, and a late cycle is not caught up with.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from functools import partial

from servobus.engine.coalescer import Ticket
from servobus.values import Outcome, ServoGoal


@dataclass(slots=True, eq=False)
class Ramp:
    """The way of one servo from where it was last sent to its goal."""

    goal: ServoGoal
    node: int
    ttl: float
    step: float
    """Units a cycle, signed."""
    setpoint: float
    due: float | None = None
    """When the next setpoint shall leave. None: the first was not delivered yet, or the last has left."""


class SetpointRamps:
    """The rows under way on one bus. `cut(servo, error)` is told of one that ends before its goal."""

    def __init__(self, hz: float, cut: Callable[[str, Exception], None]) -> None:
        self._period = 1.0 / hz
        self._cut = cut
        self._ramps: dict[str, Ramp] = {}
        self._sent: dict[str, float] = {}
        """The last setpoint of each servo that was ever led: where it stands, or is on its way to."""

    def __len__(self) -> int:
        return len(self._ramps)

    def begin(self, ticket: Ticket, speed: float, now: float) -> None:
        """Lead this goal's servo at `speed` (unit/s), instead of to any goal before. The ticket becomes the first setpoint's.
        A goal whose start nobody knows is sent as it is."""
        goal = ticket.goal
        start = self._sent.get(ticket.servo, goal.start)
        if start is None:
            self.drop({ticket.servo})
            return
        step = speed * self._period
        ramp = Ramp(goal, ticket.node, ticket.expires - now, step if goal.goal.value >= start else -step, start)
        self._ramps[ticket.servo] = ramp
        ticket.goal = self._advance(ramp)
        tell = ticket.done

        def done(result: Outcome | Exception) -> None:
            if isinstance(result, Outcome) and result is not Outcome.SUPERSEDED:
                self._delivered(ramp, now)
            else:
                self._end(ramp)
            tell(result)

        ticket.done = done

    def due(self, now: float) -> list[Ticket]:
        """The setpoints of this cycle."""
        tickets = []
        for servo, ramp in self._ramps.items():
            if ramp.due is not None and ramp.due <= now:
                goal = self._advance(ramp)
                last = ramp.setpoint == ramp.goal.goal.value
                following = ramp.due + self._period
                ramp.due = None if last else following if following > now else now + self._period
                tickets.append(Ticket(goal, ramp.node, now + ramp.ttl, partial(self._went, ramp)))
                self._sent[servo] = ramp.setpoint
        return tickets

    def leads(self, servo: str) -> bool:
        """It is still on its way."""
        return servo in self._ramps

    def next_due(self) -> float | None:
        return min((ramp.due for ramp in self._ramps.values() if ramp.due is not None), default=None)

    def drop(self, servos: Collection[str] | None = None) -> None:
        """Lead these no further, or nobody. Where they were last sent stays known."""
        for servo in list(self._ramps) if servos is None else servos:
            self._ramps.pop(servo, None)

    def forget(self, servo: str) -> None:
        """It may have been moved by others: its next way begins where it is."""
        self.drop({servo})
        self._sent.pop(servo, None)

    @staticmethod
    def _advance(ramp: Ramp) -> ServoGoal:
        """One cycle on; the last step ends at the goal itself."""
        target = ramp.goal.goal.value
        ramp.setpoint = target if abs(target - ramp.setpoint) <= abs(ramp.step) else ramp.setpoint + ramp.step
        return replace(ramp.goal, goal=replace(ramp.goal.goal, value=ramp.setpoint))

    def _delivered(self, ramp: Ramp, now: float) -> None:
        """The first setpoint was; the others follow, if it was not the last."""
        self._sent[ramp.goal.servo] = ramp.setpoint
        if ramp.setpoint == ramp.goal.goal.value:
            self._end(ramp)
        else:
            ramp.due = now + self._period

    def _went(self, ramp: Ramp, result: Outcome | Exception) -> None:
        if isinstance(result, Exception) and self._end(ramp):
            self._cut(ramp.goal.servo, result)
        elif ramp.due is None:
            self._end(ramp)

    def _end(self, ramp: Ramp) -> bool:
        """False: it was replaced or dropped before."""
        if self._ramps.get(ramp.goal.servo) is not ramp:
            return False
        del self._ramps[ramp.goal.servo]
        return True
