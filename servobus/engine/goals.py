"""The goals of one bus, from where they are put to the jobs that carry them. Pure: it is given the time.

A group of goals leaves like this:

1. The coalescer hands out goals whose nodes are all online. Goals of one batch leave together or not at all.
2. Servos that were not verified lately are verified first (`verification.py`); the goals wait again meanwhile.
3. The driver makes plans of the goals. The first is the next job, the others wait here.
4. A plan that waited is given up if a node of it is not online any more or a goal of it is too old: it is planned anew.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Sequence
from functools import partial

from servobus.engine.coalescer import Coalescer, Group, Ticket
from servobus.engine.health import NodeTable
from servobus.engine.job import Callback, Job, JobKind
from servobus.engine.ramp import SetpointRamps
from servobus.engine.verification import Verification
from servobus.errors import ServobusError
from servobus.protocols.base import Driver, GoalPlan
from servobus.values import Outcome


class GoalQueue:
    """What waits to be moved on one bus."""

    def __init__(self, driver: Driver, nodes: NodeTable, ramps: SetpointRamps, verification: Verification) -> None:
        self.coalescer = Coalescer()
        self.ramps = ramps
        self.verification = verification
        self.split_groups = 0
        """Groups that did not fit one plan."""
        self.turns = 0
        """Plans begun."""
        self._driver = driver
        self._nodes = nodes
        self.planned: deque[tuple[Job, Sequence[Ticket]]] = deque()
        """Plans that wait behind the first of their group."""

    def __len__(self) -> int:
        return len(self.coalescer) + len(self.planned)

    def put(self, ticket: Ticket, now: float, *, speed: float | None, start: float | None) -> None:
        """Take the newest goal of a servo. With `speed` (unit/s) the host ramps it from `start`, the last setpoint."""
        if speed is not None:
            self.ramps.begin(ticket, speed, start, now)
        elif self.ramps.active:
            self.ramps.drop({ticket.servo})
        self.coalescer.put(ticket)

    def take(self, now: float) -> Job | None:
        """Return the next job: a plan of goals, or the verification that comes before one."""
        for ticket in self.ramps.due(now):
            self.coalescer.put(ticket)
        while self.planned:
            job, tickets = self.planned.popleft()
            ready = self._nodes.reachable()
            if all(ticket.node in ready and ticket.expires > now and not ticket.gone() for ticket in tickets):
                self.turns += 1
                return job
            # A servo of it missed a reply: it may have restarted.
            self._unplan(job, tickets)
        return self._plan(now)

    def drop(self, error: Callable[[str], ServobusError], servos: Collection[str] | None = None) -> None:
        """End all goals that have not left, or those of some servos, with an error. The others of a plan are planned anew."""
        planned, self.planned = self.planned, deque()
        for job, tickets in planned:
            if servos is None or any(ticket.servo in servos for ticket in tickets):
                self._unplan(job, tickets)
            else:
                self.planned.append((job, tickets))
        self.coalescer.drop(error, servos)
        self.ramps.drop(servos)

    def _unplan(self, job: Job, tickets: Sequence[Ticket]) -> None:
        """Take a plan back that has not begun; its goals wait again."""
        assert job.plan is not None
        job.plan.close()
        for ticket in tickets:
            self.coalescer.put_back(ticket)

    def _plan(self, now: float) -> Job | None:
        """Return the first plan of the next group, or its verification. None: no group is ready."""
        while len(self.coalescer):
            group = self.coalescer.take(now, self._nodes.reachable())
            if group is None:
                return None
            check = self.verification.job(group.tickets, now)
            if check is not None:
                for ticket in group.tickets:
                    self.coalescer.put_back(ticket)
                return check
            try:
                plans = self._driver.plan_goals(
                    [ticket.goal for ticket in group.tickets], together=group.together, confirm=group.confirm
                )
            except Exception as error:  # noqa: BLE001 - a mistake in a driver ends its goals, never the bus
                for ticket in group.tickets:
                    ticket.done(error)
                continue
            self.split_groups += len(plans) > 1
            self.turns += 1
            first, *others = [_goal_job(plan, group) for plan in plans]
            self.planned.extend(others)
            return first[0]
        return None


def _goal_job(plan: GoalPlan, group: Group) -> tuple[Job, Sequence[Ticket]]:
    tickets = group.tickets
    if len(plan.servos) < len(tickets):
        tickets = [ticket for ticket in tickets if ticket.servo in plan.servos]
    expires = max([ticket.expires for ticket in tickets])
    sink = Callback(partial(_end_tickets, tickets))
    return Job(sink, expires, plan=plan.plan, node=tickets[0].node, kind=JobKind.MOTION), tickets


def _end_tickets(tickets: Sequence[Ticket], result: dict[str, Outcome | Exception] | Exception) -> None:
    """End the tickets of one plan, with a result for each or with one error for all."""
    if isinstance(result, dict):
        for ticket in tickets:
            ticket.done(result[ticket.goal.servo])
    else:
        for ticket in tickets:
            ticket.done(result)
