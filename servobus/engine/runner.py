"""What has the line: the job under way, its fences, its retries and its end. Pure: `now` is given.

A plan keeps the line from its first frame to its last; only an e-stop comes between. The cases are these:

1. An e-stop waits: a plan that moves something fails, any other plan is suspended and goes on afterwards. An e-stop
   never interrupts an earlier one: a hold that goes on after a limp would switch the torque on again.
2. The request could have a reply that is mistaken for a late one, because a node of it is doubtful: a fence comes first.
   Requests without a reply need none, and the requests of a fence are not fenced themselves.
3. A request without its reply is sent once more if it is idempotent, has tries left, belongs to no fence, its nodes are
   not offline and, where it moves something, its time has not passed. A request retried alone lets the other nodes have
   their turns first.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from servobus.engine.health import OFFLINE, ONLINE, Node, NodeTable
from servobus.engine.job import Done, Failed, Job, JobKind, NodeRestarted, Step
from servobus.engine.scheduler import Scheduler
from servobus.engine.stats import BusStats, Cause, Counter
from servobus.engine.turn import Turn
from servobus.errors import DeviceError, EStopped, NotEnabled, ReplyTimeout, ServobusError
from servobus.protocols.base import Reply, Request

ESTOP = JobKind.ESTOP
TIMEOUTS = {
    Cause.SILENT: ("no answer", "is it powered, are id and baud rate right?"),
    Cause.GARBLED: ("garbled replies", "are there two servos with this id, another baud rate, or noise on the line?"),
    Cause.FOREIGN: ("only replies of other nodes", "does a second program or master use the line?"),
    Cause.NO_ANSWER: ("the gateway reports no answer", "is it powered, are id and baud rate right?"),
    Cause.LATE: ("only a late reply", "it is slower than expected: set timeout_ms of the bus"),
}
"""Cause -> what happened, and the next step."""


class JobRunner:
    """Takes one job after the other from the scheduler and carries it through its requests."""

    def __init__(self, bus: str, scheduler: Scheduler, nodes: NodeTable, stats: BusStats) -> None:
        self.job: Job | None = None
        """The job that has the line: a plan, or the request under way."""
        self.suspended: Job | None = None
        """A plan that goes on after the e-stop."""
        self.bus = bus
        self.scheduler = scheduler
        self.nodes = nodes
        self.stats = stats

    @property
    def estop_pending(self) -> bool:
        """An e-stop waits or is under way: it is transmitted even on a line that never falls silent."""
        return self.scheduler.estop_pending or (self.job is not None and self.job.kind is ESTOP)

    def next_request(self, now: float) -> Request[Any] | None:
        """Return the next request of the job under way or of the next job, behind a fence where one is due."""
        while (job := self.current_job(now)) is not None:
            request = job.request
            if not request.replies or job.fencing:
                return request
            doubtful = self.doubtful_node(request)
            if doubtful is None:
                return request
            self.stats.counts[Counter.FENCES] += 1
            self._apply(job, job.put_fence(self.scheduler.fence(doubtful)))
        return None

    def current_job(self, now: float) -> Job | None:
        """Return the job that has the line, begun if need be."""
        job = self.job
        if job is None:
            if self.suspended is None:
                job = self.scheduler.next_job(now)
                if job is None or job.plan is None:  # nearly always
                    self.job = job
                    return job
                self._begin(job)
        elif job.kind is not ESTOP and self.scheduler.estop_pending:
            self._make_way(job)
        while self.job is None:
            if self.suspended is not None and not self.scheduler.estop_pending:
                self.job, self.suspended = self.suspended, None
                return self.job
            job = self.scheduler.next_job(now)
            if job is None:
                return None
            self._begin(job)
        return self.job

    def _begin(self, job: Job) -> None:
        self.job = job
        if job.plan is not None:
            self.stats.counts[Counter.FENCES] += job.kind is JobKind.PROBE
            self._apply(job, job.begin())

    def _make_way(self, job: Job) -> None:
        self.job = None
        if job.kind is JobKind.MOTION:
            job.fail(self.estopped(""))
        else:
            self.suspended = job

    def doubtful_node(self, request: Request[Any]) -> Node | None:
        by_id = self.nodes.by_id
        for node_id in request.nodes:
            node = by_id.get(node_id) or self.nodes.node(node_id)
            if node.health is not ONLINE:
                return node
        return None

    # Results

    def conclude(self, job: Job, request: Request[Any], replies: Sequence[Reply]) -> None:
        """Parse the replies of a turn, and go on with its job."""
        try:
            value = request.parse(replies)
        except Exception as error:  # noqa: BLE001 - a mistake in a driver ends its job, never the bus
            if isinstance(error, DeviceError):
                for node_id in request.nodes:
                    self.nodes.node(node_id).causes[Cause.REFUSED] += 1
            self._apply(job, job.give_up(error))
            return
        if job.plan is None and not job.fencing:
            if self.job is job:
                self.job = None
            if not job.sink.done():
                job.sink.set_result(value)
        else:
            self._apply(job, job.advance(value))

    def _apply(self, job: Job, step: Step) -> None:
        """Keep the job on the line, or end it."""
        error: Exception | None = None
        if isinstance(step, NodeRestarted) and job.kind is JobKind.MOTION:
            error = NotEnabled("the servo has restarted and is disabled: nothing was sent; enable it again")
        elif isinstance(step, Failed):
            error = step.error
        elif not isinstance(step, Done):
            return
        if self.job is job:
            self.job = None
        if isinstance(step, Done):
            job.succeed(step.value)
        elif error is not None:
            job.fail(error.at(bus=self.bus) if isinstance(error, ServobusError) else error)

    def retry(self, turn: Turn, cause: Cause, now: float) -> None:
        """Send the request once more, or give it up: case 3 above. `cause`: why it has no value."""
        job, request = turn.job, turn.request
        job.attempts += 1
        if job.cause is None or cause is not Cause.SILENT:
            job.cause = cause
        offline = any(self.nodes.node(node).health is OFFLINE for node in request.nodes)
        too_late = job.kind is JobKind.MOTION and now >= job.expires
        # The request of a fence is not repeated as it was: its reply may still come, and must be fenced again.
        if not request.idempotent or job.fencing or too_late or job.attempts >= job.tries or offline:
            self._apply(job, job.give_up(self._timeout(job, request), offline=offline))
            return
        self.stats.counts[Counter.RETRIES] += 1
        job.request = (request.plain() if turn.echoes else None) or request
        if job.plan is None:
            if self.job is job:
                self.job = None
            self.scheduler.retry(job)

    def _timeout(self, job: Job, request: Request[Any]) -> ReplyTimeout:
        tries = "1 try" if job.attempts == 1 else f"{job.attempts} tries"
        problem, step = TIMEOUTS[job.cause or Cause.SILENT]
        return ReplyTimeout(f"{problem} after {tries}: {step}{job.applied}", bus=self.bus, request=request, raw=request.frame)

    def estopped(self, servo: str) -> ServobusError:
        return EStopped("the e-stop came first: nothing more was sent", bus=self.bus, servo=servo or None)
