"""Jobs that wait for the line: in order for each node, in turn between nodes. Pure: the time is given.

One busy caller cannot starve the servos of another, because the line goes round the nodes that have work; and what
was asked of one node happens in the order it was asked. The queue is bounded: beyond it callers get `Overloaded`, not
a growing list.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any, Protocol

from servobus.errors import Overloaded, ReplyTimeout, ServobusError
from servobus.protocols.base import Plan, Request

TRIES = 3


class Sink(Protocol):
    """Where the result goes; an asyncio.Future is one."""

    def done(self) -> bool:
        """Nobody waits any more: the job need not be begun."""

    def set_result(self, value: Any, /) -> None: ...

    def set_exception(self, error: BaseException, /) -> None: ...


class Callback:
    """A sink that calls back: for jobs no caller awaits."""

    __slots__ = ("_call", "_done")

    def __init__(self, call: Callable[[Any], None]) -> None:
        self._call = call
        self._done = False

    def done(self) -> bool:
        return self._done

    def set_result(self, value: Any, /) -> None:
        self._done = True
        self._call(value)

    def set_exception(self, error: BaseException, /) -> None:
        self._done = True
        self._call(error)


class Job:
    """One request, or one plan whose frames nothing but an e-stop parts."""

    __slots__ = ("attempts", "expires", "motion", "node", "plan", "recovery", "request", "session", "sink", "tries", "urgent")

    def __init__(
        self,
        sink: Sink,
        expires: float,
        *,
        request: Request[Any] | None = None,
        plan: Plan[Any] | None = None,
        node: int = 0,
        motion: bool = False,
        urgent: bool = False,
        recovery: bool = False,
        session: object = None,
        tries: int = TRIES,
    ) -> None:
        self.sink = sink
        self.expires = expires
        self.request = request
        self.plan = plan
        self.node = request.node if request is not None else node
        self.motion = motion
        """Moves something: refused after a restart of its node, dropped by an e-stop."""
        self.urgent = urgent
        """Is begun even while its node is offline: ping."""
        self.recovery = recovery
        """Its plan is the fence, so none is put before it."""
        self.session = session
        """The exclusive session it belongs to."""
        self.tries = tries
        """Times a request of it that may be repeated is said."""
        self.attempts = 0

    def succeed(self, value: Any) -> None:
        if not self.sink.done():
            self.sink.set_result(value)

    def fail(self, error: BaseException) -> None:
        """A plan that never ran to its end is closed, so that it knows."""
        if self.plan is not None:
            self.plan.close()
        if not self.sink.done():
            self.sink.set_exception(error)


class RequestQueue:
    """First come, first served for each node; round robin over nodes."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._length = 0
        self._lines: dict[int, deque[Job]] = {}

    def __len__(self) -> int:
        return self._length

    def put(self, job: Job) -> None:
        """Raises Overloaded when full."""
        if self._length >= self._limit:
            raise overloaded(self._length)
        line = self._lines.get(job.node)
        if line is None:
            line = self._lines[job.node] = deque()
        line.append(job)
        self._length += 1

    def put_back(self, job: Job) -> None:
        """Before everything of its node: it was begun already. Never refused."""
        self._lines.setdefault(job.node, deque()).appendleft(job)
        self._length += 1

    def take(self, now: float, session: object = None) -> Job | None:
        """The next job; only those of `session`, when one is given: those pass whatever else waits for their node. Jobs nobody
        awaits are dropped, those too old fail."""
        for _ in range(len(self._lines)):
            node = next(iter(self._lines))
            line = self._lines.pop(node)
            job = self._first_wanted(line, now, session)
            if line:
                self._lines[node] = line  # at the end of the round
            if job is not None:
                return job
        return None

    def _first_wanted(self, line: deque[Job], now: float, session: object) -> Job | None:
        while line:
            at = 0 if session is None else next((at for at, job in enumerate(line) if job.session is session), None)
            if at is None:
                return None
            job = line[at]
            del line[at]
            self._length -= 1
            if self._still_wanted(job, now):
                return job
        return None

    def expire(self, now: float) -> None:
        """Fail what waited too long; the oldest of each node stands first, so only those are looked at."""
        for line in self._lines.values():
            while line and line[0].expires <= now:
                self._length -= 1
                self._still_wanted(line.popleft(), now)

    def next_expiry(self) -> float | None:
        return min((line[0].expires for line in self._lines.values() if line), default=None)

    def remove(self, unwanted: Callable[[Job], bool]) -> list[Job]:
        """Take out all jobs that are unwanted, in order for each node."""
        removed: list[Job] = []
        for node, line in list(self._lines.items()):
            kept: deque[Job] = deque()
            for job in line:
                (removed if unwanted(job) else kept).append(job)
            if kept:
                self._lines[node] = kept
            else:
                del self._lines[node]
        self._length -= len(removed)
        return removed

    @staticmethod
    def _still_wanted(job: Job, now: float) -> bool:
        if job.sink.done():
            job.fail(_abandoned())
            return False
        if job.expires <= now:
            job.fail(_too_late(job))
            return False
        return True


def overloaded(waiting: int) -> Overloaded:
    return Overloaded(f"{waiting} requests wait already: ask for less, or later")


def _too_late(job: Job) -> ReplyTimeout:
    frame = job.request.frame if job.request is not None else b""
    if job.attempts:
        message = "no answer, and no time to ask again: what was asked may have been applied"
    else:
        message = "it waited too long for its turn: the line is busier than it can carry (`servobus check`)"
    return ReplyTimeout(message, request=job.request, raw=frame)


def _abandoned() -> ServobusError:
    return ServobusError("nobody waits for it any more")
