"""Decides the next turn: e-stop, goals, requests, polls, probes. Pure: `next_job(now)` returns a decision, the
master acts on it.

Two rules hold. A higher class goes first; and after each turn of a class, one turn of a lower class follows if any
waits, so that nothing starves: a flood of goals still leaves every second turn to requests, every fourth to polls,
every eighth to probes.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import Any

from servobus.engine.coalescer import Coalescer, Group, Ticket
from servobus.engine.health import Condition, Health, Node
from servobus.engine.polls import PollGrid
from servobus.engine.queue import Callback, Job, RequestQueue, overloaded
from servobus.engine.ramp import SetpointRamps
from servobus.errors import DeviceError, ReplyTimeout, ServobusError
from servobus.protocols.base import Driver, GoalPlan, Plan
from servobus.values import Outcome

QUEUE_LIMIT = 1024
"""Jobs that may wait on one bus."""
PROBE_PAUSE = 0.1
"""Seconds until a node is asked again that answers a probe, but not as it should."""
POLL_PATIENCE = 1.0
"""Seconds after which a poll that could not be sent is not wanted any more."""

OFFLINE = "it is offline: is it powered, are id and baud rate right? It is probed, and served again as soon as it answers"


class Scheduler:
    """The five classes of one bus and the order between them."""

    def __init__(
        self,
        driver: Driver,
        health: Health,
        *,
        on_update: Callable[[Any], None],
        on_restart: Callable[[Node], None],
        on_cut: Callable[[str, Exception], None],
        cycle: float,
        limit: int = QUEUE_LIMIT,
    ) -> None:
        self.driver = driver
        self.health = health
        self.coalescer = Coalescer()
        self.profile = SetpointRamps(cycle, on_cut)
        self.requests = RequestQueue(limit)
        self.estop: deque[Job] = deque()
        self.stops: deque[Job] = deque()
        """Stops of single servos: before everything but an e-stop, and no plan is torn for them."""
        self.session: object = None
        """While set, polls, probes and goals rest and only this session's requests are served."""
        self.split_groups = 0
        self.goal_turns = 0
        self._limit = limit
        self._on_update = on_update
        self._on_restart = on_restart
        self._goal_jobs: deque[tuple[Job, list[Ticket]]] = deque()
        self.polls = PollGrid()
        self._parked: list[Job] = []
        self._parked_until = math.inf
        """When the first of those set aside has waited long enough."""
        self._lanes = (self._next_goal, self._next_request, self._next_poll, self._next_probe)
        self._upwards = list(enumerate(self._lanes))[::-1]
        self._owed = [False] * len(self._lanes)

    # What waits

    def submit(self, job: Job, now: float) -> None:
        """Raises Overloaded. A job for an offline node waits aside for as long as an answer would have taken, and fails then,
        unless the node comes back: a dead servo costs the line nothing."""
        node = self.health.node(job.node)
        if node.condition is Condition.OFFLINE and not job.urgent:
            if len(self._parked) >= self._limit:
                raise overloaded(len(self._parked))
            self._park([job], now + node.deadline)
        else:
            self.requests.put(job)

    def retry(self, job: Job) -> None:
        """It failed and may be said again: it stays the first of its node, and the other nodes have their turns before it."""
        self.requests.put_back(job)

    def waiting(self) -> int:
        """Everything that waits, for people."""
        return (
            len(self.requests)
            + len(self.coalescer)
            + len(self._parked)
            + len(self.estop)
            + len(self.stops)
            + len(self._goal_jobs)
        )

    # The decision

    def next_job(self, now: float) -> Job | None:
        """What shall be on the wire next; None: nothing yet, see `wake`."""
        if now >= self._parked_until:  # on a busy line nobody calls `expire`
            self._end_parked(now)
        if self.estop:
            return self.estop.popleft()
        if self.stops:
            return self.stops.popleft()
        if self.session is not None:
            return self.requests.take(now, self.session)
        if self._only_requests(now):  # nearly always, where callers ask as fast as they can
            job = self.requests.take(now)
            return None if job is None else self._served(1, job)
        for lane, take in enumerate(self._lanes):
            if not self._owed[lane] and (job := take(now)) is not None:
                return self._served(lane, job)
        # Nobody waits to whom a turn is owed, so the others may go on; the lowest of them first: those above owe it one.
        for lane, take in self._upwards:
            if self._owed[lane] and (job := take(now)) is not None:
                return self._served(lane, job)
        self._owed = [False] * len(self._lanes)  # nobody waits, so nobody is owed anything
        return None

    def _only_requests(self, now: float) -> bool:
        """No other class has anything to say."""
        return not (
            len(self.requests) == 0
            or self._goal_jobs
            or len(self.coalescer)
            or len(self.profile)
            or self.polls.due <= now
            or self.health.troubled
        )

    def _served(self, lane: int, job: Job) -> Job:
        """Every class above has had its lower turn; this one owes one now."""
        for above in range(lane):
            self._owed[above] = False
        self._owed[lane] = True
        return job

    def wake(self) -> float | None:
        """The next moment at which something becomes due or too old, if nothing else happens."""
        times = [self._parked_until, self.requests.next_expiry(), self.coalescer.next_expiry()]
        if self.session is None:
            times += (self.polls.due, self.health.next_probe(), self.profile.next_due())
        soonest = min(time for time in times if time is not None)
        return None if soonest == math.inf else soonest

    def expire(self, now: float) -> None:
        """End what is too old. Called when nothing can be sent, or nothing is due."""
        self.requests.expire(now)
        self.coalescer.expire(now)
        self._end_parked(now)

    def node_changed(self, node: Node) -> None:
        """Jobs set aside for a node that came back go on; those in the queue of one that went offline are set aside."""
        if node.condition is Condition.OFFLINE:
            went = node.next_probe - node.backoff
            self._park(self.requests.remove(lambda job: job.node == node.id and not job.urgent), went + node.deadline)
            return
        for job in reversed(self._unpark(lambda job: job.node == node.id)):
            self.requests.put_back(job)

    def _park(self, jobs: Sequence[Job], until: float) -> None:
        for job in jobs:
            job.expires = min(job.expires, until)
            self._parked_until = min(self._parked_until, job.expires)
        self._parked.extend(jobs)

    def _unpark(self, wanted: Callable[[Job], bool]) -> list[Job]:
        out: list[Job] = []
        kept: list[Job] = []
        for job in self._parked:
            (out if wanted(job) else kept).append(job)
        self._parked = kept
        self._parked_until = min((job.expires for job in kept), default=math.inf)
        return out

    def _end_parked(self, now: float) -> None:
        for job in self._unpark(lambda job: job.expires <= now or job.sink.done()):
            job.fail(ReplyTimeout(OFFLINE, request=job.request, raw=job.request.frame if job.request else b""))

    def drop_goals(self, error: Callable[[str], ServobusError], servos: Collection[str] | None = None) -> None:
        """End all goals that have not left, or those of some servos, with an error; the others of a frame are planned anew."""
        goal_jobs, self._goal_jobs = self._goal_jobs, deque()
        for job, tickets in goal_jobs:
            if servos is None or any(ticket.servo in servos for ticket in tickets):
                self._unplan(job, tickets)
            else:
                self._goal_jobs.append((job, tickets))
        self.coalescer.drop(error, servos)
        self.profile.drop(servos)

    def drop(self, error: Callable[[str], ServobusError], *, motion_only: bool) -> None:
        """End everything that waits, or only what would move something."""
        self.drop_goals(error)
        unwanted = self.requests.remove(lambda job: job.motion or not motion_only)
        unwanted += self._unpark(lambda job: job.motion or not motion_only)
        unwanted += self.stops
        self.stops.clear()
        if not motion_only:
            unwanted += self.estop
            self.estop.clear()
        for job in unwanted:
            job.fail(error(""))

    # The lanes

    def _next_goal(self, now: float) -> Job | None:
        for ticket in self.profile.due(now):
            self.coalescer.put(ticket)
        while self._goal_jobs or self._plan_goals(now):
            job, tickets = self._goal_jobs.popleft()
            ready = self.health.reachable()
            if all(ticket.node in ready and ticket.expires > now and not ticket.gone() for ticket in tickets):
                self.goal_turns += 1
                return job
            # A frame of a split group waited, and is too old now, or a servo of it missed an answer: it may have restarted.
            self._unplan(job, tickets)
        return None

    def _unplan(self, job: Job, tickets: Sequence[Ticket]) -> None:
        """The frame does not leave; its goals wait again."""
        assert job.plan is not None
        job.plan.close()
        for ticket in tickets:
            self.coalescer.put_back(ticket)

    def _plan_goals(self, now: float) -> bool:
        """Make jobs of the next group; False: none is ready."""
        while len(self.coalescer):
            group = self.coalescer.take(now, self.health.reachable())
            if group is None:
                return False
            try:
                turns = self.driver.plan_goals(
                    [ticket.goal for ticket in group.tickets], together=group.together, confirm=group.confirm
                )
            except Exception as error:  # noqa: BLE001 - a mistake in a driver ends its goals, never the bus
                for ticket in group.tickets:
                    ticket.done(error)
                continue
            self.split_groups += len(turns) > 1
            self._goal_jobs.extend(self._goal_job(turn, group) for turn in turns)
            return True
        return False

    @staticmethod
    def _goal_job(turn: GoalPlan, group: Group) -> tuple[Job, list[Ticket]]:
        tickets = [ticket for ticket in group.tickets if ticket.servo in turn.servos]
        expires = max(ticket.expires for ticket in tickets)
        sink = Callback(lambda result: _settle(tickets, result))
        return Job(sink, expires, plan=turn.plan, node=tickets[0].node, motion=True), tickets

    def _next_request(self, now: float) -> Job | None:
        return self.requests.take(now)

    def _next_poll(self, now: float) -> Job | None:
        while (poll := self.polls.take(now)) is not None:
            request = poll.request(self.health.reachable())
            if request is not None:
                return Job(Callback(self._on_update), now + POLL_PATIENCE, request=request, tries=1)
        return None

    def _next_probe(self, now: float) -> Job | None:
        node = self.health.due_probe(now)
        if node is None:
            return None
        return Job(
            Callback(partial(_probed, node, now + PROBE_PAUSE)),
            now + POLL_PATIENCE,
            plan=self.recovery(node),
            node=node.id,
            recovery=True,
        )

    def recovery(self, node: Node) -> Plan[bool]:
        """The fence, and whether the servo still is as we left it. What makes a doubtful node believed again."""
        kept = yield from self.driver.fence(node.id, list(node.outstanding), node.enabled)
        if not kept:
            self._on_restart(node)
        self.health.recovered(node)
        return kept


def _settle(tickets: Sequence[Ticket], result: dict[str, Outcome | Exception] | Exception) -> None:
    """One result or one error for all of a turn's tickets."""
    for ticket in tickets:
        ticket.done(result[ticket.servo] if isinstance(result, dict) else result)


def _probed(node: Node, later: float, result: object) -> None:
    """A probe's outcome stands in the node's health; one that was refused is not asked again at once."""
    if isinstance(result, DeviceError):
        node.next_probe = max(node.next_probe, later)
