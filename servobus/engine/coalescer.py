"""Keeps the latest goal of each servo and hands them out as groups. Pure: the time is given.

A newer goal replaces the older one of the same servo wherever that one stood; a goal whose time to live has passed is
dropped, never replayed. Goals that were asked for together leave together or not at all: when one of them is dropped
(expired, disabled, its caller gone), the others are too. A newer goal for one of them drops nothing: that servo has
what its caller wanted last, and the others still leave in one turn.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

from servobus.errors import ActionWithheld, GoalExpired, ServobusError
from servobus.values import Outcome, ServoGoal


def _never() -> bool:
    return False


def _expired(servo: str) -> ServobusError:
    return GoalExpired(
        "its time to live passed before its first byte could leave: the line or the servo is busy or gone", servo=servo
    )


@dataclass(slots=True, eq=False)
class Ticket:
    """A goal under way. `done` is called exactly once."""

    goal: ServoGoal
    node: int
    expires: float
    done: Callable[[Outcome | Exception], None]
    batch: int | None = None
    """Tickets with the same batch leave together."""
    confirm: bool = False
    gone: Callable[[], bool] = _never
    """Whether its caller has left: then it is dropped, and nobody is told."""

    @property
    def servo(self) -> str:
        return self.goal.servo


@dataclass(frozen=True, slots=True)
class Group:
    """Goals that shall leave now."""

    tickets: Sequence[Ticket]
    together: bool
    confirm: bool


class Coalescer:
    """At most one ticket a servo, so it is bounded by the config."""

    def __init__(self) -> None:
        self._tickets: dict[str, Ticket] = {}

    def __len__(self) -> int:
        return len(self._tickets)

    def put(self, ticket: Ticket) -> None:
        """The newest goal of its servo; the older one ends as SUPERSEDED."""
        older = self._tickets.get(ticket.servo)
        self._tickets[ticket.servo] = ticket
        if older is not None:
            older.done(Outcome.SUPERSEDED)

    def put_back(self, ticket: Ticket) -> None:
        """It was taken and could not leave: it waits again, unless a newer goal has come."""
        if ticket.servo in self._tickets:
            ticket.done(Outcome.SUPERSEDED)
        else:
            self._tickets[ticket.servo] = ticket

    def take(self, now: float, ready: Collection[int]) -> Group | None:
        """The next group whose nodes are all ready. Expired goals, and those nobody waits for, are dropped on the way."""
        self.expire(now)
        for first in self._tickets.values():
            members = self._mates(first, ready)
            if members:
                for ticket in members:
                    del self._tickets[ticket.servo]
                return Group(members, first.batch is not None, first.confirm)
        return None

    def expire(self, now: float) -> None:
        """End what is too old (at the very moment it expires) or waited for by nobody, and its group with it."""
        late = [ticket for ticket in self._tickets.values() if ticket.expires <= now or ticket.gone()]
        if late:
            self._end(late, _expired)

    def next_expiry(self) -> float | None:
        return min((ticket.expires for ticket in self._tickets.values()), default=None)

    def drop(self, error: Callable[[str], ServobusError], servos: Collection[str] | None = None) -> None:
        """End all goals, or those of some servos and of their groups, with an error."""
        self._end([ticket for ticket in self._tickets.values() if servos is None or ticket.servo in servos], error)

    def _end(self, ended: Sequence[Ticket], error: Callable[[str], ServobusError]) -> None:
        """These end with the error; those asked for together with one of them are withheld."""
        batches = {ticket.batch for ticket in ended if ticket.batch is not None}
        mates = [ticket for ticket in self._tickets.values() if ticket.batch in batches and ticket not in ended]
        for ticket in (*ended, *mates):
            del self._tickets[ticket.servo]
        names = ", ".join(ticket.servo for ticket in ended)
        for ticket in ended:
            if not ticket.gone():
                ticket.done(error(ticket.servo))
        reason = f"it was asked for together with {names}, which was dropped before it could leave: nothing was sent"
        for ticket in mates:
            ticket.done(ActionWithheld(reason, servo=ticket.servo))

    def _mates(self, first: Ticket, ready: Collection[int]) -> list[Ticket]:
        """All that can leave with this one; empty while it cannot leave."""
        mates = [ticket for ticket in self._tickets.values() if ticket.batch == first.batch and ticket.confirm == first.confirm]
        if first.batch is None:
            return [ticket for ticket in mates if ticket.node in ready] if first.node in ready else []
        return mates if all(ticket.node in ready for ticket in mates) else []
