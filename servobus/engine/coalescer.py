"""Keeps the latest goal of each servo and hands goals out as groups. Pure: it is given the time.

A newer goal replaces the older one of the same servo wherever that one waits. A goal whose time has passed is dropped,
never sent later. Goals that were asked for together leave together or not at all: when one of them is dropped (expired,
disabled, its caller gone), the others are too. A newer goal for one of them drops nothing: that servo gets what its
caller wanted last, and the others still leave in one plan.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

from servobus.errors import ActionWithheld, GoalExpired, ServobusError
from servobus.values import Outcome, ServoGoal


def _never() -> bool:
    return False


def _expired(servo: str) -> ServobusError:
    return GoalExpired(
        "the goal expired before its first byte could leave: the line or the servo is busy or gone; retry later", servo=servo
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
    """Returns whether its caller has left: then the goal is dropped without a result."""
    put_at: float = 0.0
    first_expires: float = math.inf
    """When the first of the goals expired that it, and those before it, have replaced."""

    @property
    def servo(self) -> str:
        return self.goal.servo


@dataclass(frozen=True, slots=True)
class Group:
    """Goals that leave now."""

    tickets: Sequence[Ticket]
    together: bool
    confirm: bool


class Coalescer:
    """Holds at most one ticket a servo, so the config bounds it."""

    __slots__ = ("tickets",)

    def __init__(self) -> None:
        self.tickets: dict[str, Ticket] = {}

    def __len__(self) -> int:
        return len(self.tickets)

    def put(self, ticket: Ticket) -> None:
        """Take the newest goal of its servo; the older one ends as SUPERSEDED.

        Where none of a stream of goals could leave for as long as one may wait, each ends as GoalExpired: the servo is dead.
        """
        servo = ticket.goal.servo
        older = self.tickets.get(servo)
        self.tickets[servo] = ticket
        if older is None:
            return
        ticket.first_expires = min(older.expires, older.first_expires)
        older.done(_expired(servo) if ticket.put_at >= ticket.first_expires else Outcome.SUPERSEDED)

    def put_back(self, ticket: Ticket) -> None:
        """Take back a goal that could not leave: it waits again, unless a newer goal has come."""
        if ticket.servo in self.tickets:
            ticket.done(Outcome.SUPERSEDED)
        else:
            self.tickets[ticket.servo] = ticket

    def take(self, now: float, ready: Collection[int]) -> Group | None:
        """Return the next group whose nodes are all ready. Goals that expired or whose caller has left are dropped first."""
        self.expire(now, ready)
        for first in self.tickets.values():
            members = self._group_of(first, ready)
            if members:
                for ticket in members:
                    del self.tickets[ticket.goal.servo]
                return Group(members, first.batch is not None, first.confirm)
        return None

    def expire(self, now: float, ready: Collection[int] = ()) -> None:
        """End the goals that expire by now or whose caller has left, and the groups they belong to.

        A goal whose node is `ready`, and that waited for others of its group, is withheld because of them.
        """
        late = [ticket for ticket in self.tickets.values() if ticket.expires <= now or ticket.gone()]
        if late:
            held_up = {ticket.batch for ticket in late if ticket.batch is not None and ticket.node not in ready}
            self._end([ticket for ticket in late if ticket.batch not in held_up or ticket.node not in ready], _expired)

    def next_expiry(self) -> float | None:
        return min((ticket.expires for ticket in self.tickets.values()), default=None)

    def drop(self, error: Callable[[str], ServobusError], servos: Collection[str] | None = None) -> None:
        """End all goals, or those of some servos and of their groups, with an error."""
        self._end([ticket for ticket in self.tickets.values() if servos is None or ticket.servo in servos], error)

    def _end(self, ended: Sequence[Ticket], error: Callable[[str], ServobusError]) -> None:
        """End these tickets with the error; withhold those that were asked for together with one of them."""
        batches = {ticket.batch for ticket in ended if ticket.batch is not None}
        mates = [ticket for ticket in self.tickets.values() if ticket.batch in batches and ticket not in ended]
        for ticket in (*ended, *mates):
            del self.tickets[ticket.servo]
        names = ", ".join(ticket.servo for ticket in ended)
        for ticket in ended:
            if not ticket.gone():
                ticket.done(error(ticket.servo))
        reason = f"the goal was asked for together with {names}, which was dropped before it could leave: nothing was sent"
        for ticket in mates:
            ticket.done(ActionWithheld(reason, servo=ticket.servo))

    def _group_of(self, first: Ticket, ready: Collection[int]) -> list[Ticket]:
        """Return everything that can leave with this ticket; nothing while it cannot leave itself."""
        batch, confirm = first.batch, first.confirm
        mates = [ticket for ticket in self.tickets.values() if ticket.batch == batch and ticket.confirm == confirm]
        if batch is None:
            return [ticket for ticket in mates if ticket.node in ready] if first.node in ready else []
        return mates if all(ticket.node in ready for ticket in mates) else []
