"""Jobs that wait for the line: in order for each node, round robin over the nodes. Pure: it is given the time.

One busy caller cannot starve the servos of another, because the line goes round the nodes that have jobs. What was
asked of one node happens in the order in which it was asked. The queue is bounded: beyond the limit callers get
`Overloaded` instead of a growing list.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from servobus.engine.job import Job
from servobus.errors import Overloaded, ReplyTimeout, ServobusError


class RequestQueue:
    """First come, first served for each node; round robin over nodes."""

    __slots__ = ("_by_node", "_limit", "length")

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._by_node: dict[int, deque[Job]] = {}
        self.length = 0

    def __len__(self) -> int:
        return self.length

    def put(self, job: Job) -> None:
        """Append a job. Raises Overloaded when the queue is full."""
        if self.length >= self._limit:
            raise overloaded(self.length)
        jobs = self._by_node.get(job.node)  # as `put_always`, without its call
        if jobs is None:
            self._by_node[job.node] = deque((job,))
        else:
            jobs.append(job)
        self.length += 1

    def put_always(self, job: Job) -> None:
        """Append a job although the queue may be full: for jobs of the bus itself, of which each node has at most one."""
        jobs = self._by_node.get(job.node)
        if jobs is None:
            self._by_node[job.node] = deque((job,))
        else:
            jobs.append(job)
        self.length += 1

    def put_back(self, job: Job) -> None:
        """Put a job that was started already at the front of its node's jobs; ignores the limit."""
        jobs = self._by_node.get(job.node)
        if jobs is None:
            self._by_node[job.node] = deque((job,))
        else:
            jobs.appendleft(job)
        self.length += 1

    def take(self, now: float, session: object = None) -> Job | None:
        """Return the next job. With `session` only a job of that session, whatever else waits for its node. Jobs whose caller
        has left are dropped, jobs that are too old fail."""
        by_node = self._by_node
        for _ in range(len(by_node)):
            node = next(iter(by_node))
            jobs = by_node.pop(node)
            job = None
            while jobs:
                job = jobs.popleft() if session is None else self._pop_of_session(jobs, session)
                if job is None:
                    break
                self.length -= 1
                if job.expires > now and not job.sink.done():
                    break
                _drop(job)
                job = None
            if jobs:
                by_node[node] = jobs  # at the end of the round
            if job is not None:
                return job
        return None

    @staticmethod
    def _pop_of_session(jobs: deque[Job], session: object) -> Job | None:
        for at, job in enumerate(jobs):
            if job.session is session:
                del jobs[at]
                return job
        return None

    def expire(self, now: float) -> None:
        """Fail the jobs that waited too long. The oldest of each node comes first, so only those are tested."""
        for jobs in self._by_node.values():
            while jobs and jobs[0].expires <= now:
                self.length -= 1
                _drop(jobs.popleft())

    def next_expiry(self) -> float | None:
        return min((jobs[0].expires for jobs in self._by_node.values() if jobs), default=None)

    def remove(self, unwanted: Callable[[Job], bool]) -> list[Job]:
        """Take out all jobs that are unwanted, in order for each node."""
        removed: list[Job] = []
        for node, jobs in list(self._by_node.items()):
            kept: deque[Job] = deque()
            for job in jobs:
                (removed if unwanted(job) else kept).append(job)
            if kept:
                self._by_node[node] = kept
            else:
                del self._by_node[node]
        self.length -= len(removed)
        return removed


def overloaded(waiting: int) -> Overloaded:
    return Overloaded(f"{waiting} requests wait already: send fewer, or retry later")


def _drop(job: Job) -> None:
    """End a job that is not begun: its caller has left, or it waited too long."""
    job.fail(ServobusError("the caller has left") if job.sink.done() else _too_late(job))


def _too_late(job: Job) -> ReplyTimeout:
    request = None if job.plan is not None else job.request
    if job.attempts:
        message = f"no reply, and no time to send the request again{job.applied}"
    else:
        message = "the request waited too long for its turn: the line is busier than it can carry (`servobus check`)"
    return ReplyTimeout(message, request=request, raw=b"" if request is None else request.frame)
