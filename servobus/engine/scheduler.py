"""Decides the next job: e-stop > goals > requests > polls > probes. Pure: `next_job(now)` returns a decision.

Two rules hold. A higher class goes first; and after each job of a class, one job of a lower class follows if any waits,
so that nothing starves: a flood of goals still leaves every second turn to requests, every fourth to polls and every
eighth to probes. Stops of single servos come before everything but an e-stop, and interrupt no plan.

While an exclusive session is open, goals, polls and probes rest and only the session's requests are served.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import Any

from servobus.engine.coalescer import Ticket
from servobus.engine.goals import GoalQueue
from servobus.engine.health import OFFLINE, Node, NodeTable
from servobus.engine.job import Callback, Job, JobKind
from servobus.engine.polls import PollGrid
from servobus.engine.queue import RequestQueue, overloaded
from servobus.engine.ramp import SetpointRamps
from servobus.engine.verification import Verification
from servobus.errors import DeviceError, ReplyTimeout, ServobusError
from servobus.protocols.base import Driver, Plan, Poll, Request
from servobus.values import Loss

QUEUE_LIMIT = 1024
"""Jobs that may wait on one bus."""
PROBE_PAUSE = 0.1
"""Seconds until the next probe of a node that answered one with a refusal."""
POLL_PATIENCE = 1.0
"""Seconds after which a poll that could not be sent is dropped."""
GOALS, REQUESTS, POLLS, PROBES = range(4)
"""The classes below an e-stop, highest first."""
CLASSES = 4

NODE_OFFLINE = (
    "the servo is offline: is it powered, are its id and baud rate right? It is served again as soon as it answers a probe"
)


class Scheduler:
    """The five classes of one bus and the order between them."""

    def __init__(
        self,
        driver: Driver,
        nodes: NodeTable,
        *,
        enabled_servos: Callable[[Node], Collection[str]],
        on_update: Callable[[Any], None],
        on_restart: Callable[[Node], None],
        on_loss: Callable[[str, Loss], None],
        blind_stops: Callable[[Node], Sequence[Request[Any]]],
        on_cut: Callable[[str, Exception], None],
        on_setpoint: Callable[[str, float], None],
        goal_rate_hz: float,
        limit: int = QUEUE_LIMIT,
    ) -> None:
        self.nodes = nodes
        ramps = SetpointRamps(goal_rate_hz, on_cut, on_setpoint)
        self.goals = GoalQueue(driver, nodes, ramps, Verification(driver, on_loss))
        self.requests = RequestQueue(limit)
        self.polls = PollGrid()
        self.session: object = None
        """The open exclusive session."""
        self.wanted: Callable[[], None] = _ignore
        """Called when something was put that may leave at once: the shell sets it, and then asks for the next action."""
        self._driver = driver
        self._limit = limit
        self._enabled_servos = enabled_servos
        self._on_update = on_update
        self._on_restart = on_restart
        self._blind_stops = blind_stops
        self._estops: deque[Job] = deque()
        self._stops: deque[Job] = deque()
        self._parked: list[Job] = []
        """Jobs for offline nodes."""
        self._parked_until = math.inf
        """When the first of the parked jobs has waited long enough."""
        self._takers = (self.goals.take, self.requests.take, self._next_poll, self._next_probe)
        self._owed = [False] * CLASSES
        """Classes that owe one turn to a lower class."""

    # What waits

    def queue(self, job: Job, now: float) -> None:
        """Queue a request or a plan. Raises Overloaded.

        A job for an offline node is parked for as long as a reply would have taken, and fails then unless the node comes back: a
        dead servo costs the line nothing.
        """
        node = self.nodes.by_id.get(job.node)
        if node is None or node.health is not OFFLINE or job.even_if_offline:
            self.requests.put(job)
            return
        if len(self._parked) >= self._limit:
            raise overloaded(len(self._parked))
        self._park([job], now + node.reply_allowance_s)

    def begins_at_once(self, job: Job, now: float) -> bool:
        """Return whether the job can skip the queue, because nothing else waits and it would be taken next; it counts as taken
        then."""
        node = self.nodes.by_id.get(job.node)
        if (
            self.requests.length
            or self._stops
            or self._estops
            or self.session is not None
            or now >= self._parked_until
            or (node is not None and node.health is OFFLINE)
            or not self._only_requests(now)
        ):
            return False
        self._served(REQUESTS, job)
        return True

    def queue_own(self, job: Job) -> None:
        """Queue a job of the bus itself, of which each node has at most one. Never refused."""
        self.requests.put_always(job)
        self.wanted()

    def retry(self, job: Job) -> None:
        """Queue a failed job again: it stays the first of its node, and the other nodes have their turns before it."""
        self.requests.put_back(job)

    def put_goal(self, ticket: Ticket, now: float, *, speed: float | None = None, start: float | None = None) -> None:
        """Take the newest goal of a servo. With `speed` (unit/s) the host ramps it from `start`, the last setpoint."""
        self.goals.put(ticket, now, speed=speed, start=start)
        self.wanted()

    def put_stop(self, job: Job) -> None:
        """Put a stop before everything that waits; an e-stop before other stops."""
        (self._estops if job.kind is JobKind.ESTOP else self._stops).append(job)

    def set_polls(self, polls: Sequence[Poll], now: float) -> None:
        self.polls.set(polls, now)
        self.wanted()

    def open_session(self) -> object:
        self.session = object()
        return self.session

    def close_session(self) -> None:
        self.session = None
        self.wanted()

    @property
    def estop_pending(self) -> bool:
        return bool(self._estops)

    def waiting(self) -> int:
        """Return the number of jobs and goals that wait, for people."""
        stops = len(self._estops) + len(self._stops)
        return stops + len(self.requests) + len(self._parked) + len(self.goals)

    # The decision

    def next_job(self, now: float) -> Job | None:
        """Return the job whose turn it is. None: nothing is due before `wake`."""
        if now >= self._parked_until:  # on a busy line nobody calls `expire`
            self._end_parked(now)
        if self._estops:
            return self._estops.popleft()
        if self._stops:
            return self._stops.popleft()
        if self.session is not None:
            return self.requests.take(now, self.session)
        if self._only_requests(now):
            # Nearly always, where callers ask as fast as they can: decided without asking each class.
            job = self.requests.take(now) if self.requests.length else None
            if job is None:
                self._owed = [False] * CLASSES
            else:  # as `_served` does
                self._owed[GOALS], self._owed[REQUESTS] = False, True
            return job
        return self._fair_job(now)

    def _only_requests(self, now: float) -> bool:
        """Return whether requests wait, and nothing of any other class can be due."""
        goals = self.goals
        return not (
            goals.planned
            or goals.coalescer.tickets
            or goals.ramps.active
            or self.polls.due <= now
            or (self.nodes.troubled and self.nodes.due_probe(now))
        )

    def _fair_job(self, now: float) -> Job | None:
        owed = self._owed
        for each, take in enumerate(self._takers):
            if not owed[each] and (job := take(now)) is not None:
                return self._served(each, job)
        # No class waits to which a turn is owed, so the others may go on; the lowest of them first: those above owe it one.
        for each in range(CLASSES - 1, -1, -1):
            if owed[each] and (job := self._takers[each](now)) is not None:
                return self._served(each, job)
        self._owed = [False] * CLASSES
        return None

    def _served(self, served: int, job: Job) -> Job:
        """Note that every class above has had its lower turn, and this one owes one now."""
        for above in range(served):
            self._owed[above] = False
        self._owed[served] = True
        return job

    def is_empty(self) -> bool:
        """Return whether nothing waits that might be sent or expire before the next poll."""
        goals = self.goals
        waiting = self.requests.length or goals.coalescer.tickets or goals.planned or self._parked or self._stops or self._estops
        return not (waiting or goals.ramps.active or self.nodes.troubled or self.session is not None)

    def rest(self, now: float) -> float | None:
        """End what is too old, and return when something becomes due; None: never. Called when nothing can be sent now."""
        if not self.is_empty():
            self.expire(now)
            return self.wake()
        return None if self.polls.due == math.inf else self.polls.due

    def wake(self) -> float | None:
        """Return when something becomes due or too old, if nothing else happens; None: never."""
        times = [self._parked_until, self.requests.next_expiry(), self.goals.coalescer.next_expiry()]
        if self.session is None:
            times += (self.polls.due, self.nodes.next_probe(), self.goals.ramps.next_due())
        soonest = min(time for time in times if time is not None)
        return None if soonest == math.inf else soonest

    def expire(self, now: float) -> None:
        """End what is too old. Called when nothing can be sent, or nothing is due."""
        self.requests.expire(now)
        self.goals.coalescer.expire(now, self.nodes.reachable())
        self._end_parked(now)

    # Offline nodes

    def node_changed(self, node: Node) -> None:
        """Park the jobs of a node that went offline, and end its ramps; serve the parked jobs of one that came back."""
        if node.health is OFFLINE:
            self.goals.ramps.end_node(node.id, ReplyTimeout(NODE_OFFLINE))
            went = node.next_probe - node.backoff
            jobs = self.requests.remove(lambda job: job.node == node.id and not job.even_if_offline)
            self._park(jobs, went + node.reply_allowance_s)
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
        if not self._parked:
            return
        for job in self._unpark(lambda job: job.expires <= now or job.sink.done()):
            request = None if job.plan is not None else job.request
            job.fail(ReplyTimeout(NODE_OFFLINE, request=request, raw=b"" if request is None else request.frame))

    # Ends

    def drop_goals(self, error: Callable[[str], ServobusError], servos: Collection[str] | None = None) -> None:
        """End all goals that have not left, or those of some servos, with an error. The others of a plan are planned anew."""
        self.goals.drop(error, servos)

    def drop(self, error: Callable[[str], ServobusError], *, motion_only: bool) -> None:
        """End everything that waits, or only what would move something."""
        self.drop_goals(error)

        def unwanted(job: Job) -> bool:
            return job.kind is JobKind.MOTION or not motion_only

        ended = [*self.requests.remove(unwanted), *self._unpark(unwanted), *self._stops]
        self._stops.clear()
        if not motion_only:
            ended += self._estops
            self._estops.clear()
        for job in ended:
            job.fail(error(""))

    # The classes

    def _next_poll(self, now: float) -> Job | None:
        while (poll := self.polls.take(now)) is not None:
            request = poll.request(self.nodes.reachable())
            if request is not None:
                sink = Callback(partial(self._polled, request.nodes))
                return Job(sink, now + POLL_PATIENCE, request=request, tries=1)
        return None

    def _polled(self, nodes: Sequence[int], result: Any) -> None:
        """A poll has ended. A node that refuses it is not well, though it answers."""
        if len(nodes) == 1:
            node = self.nodes.node(nodes[0])
            if isinstance(result, DeviceError):
                self.nodes.refused(node, result.message)
            elif not isinstance(result, Exception):
                self.nodes.accepted(node)
        self._on_update(result)

    def _next_probe(self, now: float) -> Job | None:
        node = self.nodes.due_probe(now)
        if node is None:
            return None
        sink = Callback(partial(_probed, node, now + PROBE_PAUSE))
        return Job(sink, now + POLL_PATIENCE, plan=self.fence(node), node=node.id, kind=JobKind.PROBE)

    def fence(self, node: Node) -> Plan[bool]:
        """Return the plan after which a node is believed again. Its result: whether the servo still is as we left it.

        A node that owes a stop is sent first what stops it without a question.
        """
        if node.owes_stop:
            yield from self._blind_stops(node)
        kept = yield from self._driver.fence(node.id, list(node.outstanding), self._enabled_servos(node))
        if not kept:
            self._on_restart(node)
        self.nodes.fenced(node)
        return kept


def _ignore() -> None:
    pass


def _probed(node: Node, later: float, result: object) -> None:
    """Put off the next probe of a node that refused this one; every other outcome is in the node's health already."""
    if isinstance(result, DeviceError):
        node.next_probe = max(node.next_probe, later)
