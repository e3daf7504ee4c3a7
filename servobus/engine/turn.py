"""What is on the wire: a turn (one request and what was heard since), and a run (the job it belongs to). Pure.

A turn judges the window it listens in. Valid replies that are no answer are strays, a frame identical to the request
is an echo and never an answer by itself. Bytes that are no frame cast doubt on the answer before them, for with an
8-bit sum they may be what is left of another frame that was cut in two by accident: that answer is not believed, and
when it was the last the whole window is rejected.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from servobus.engine.queue import Job
from servobus.errors import ReplyTimeout
from servobus.protocols.base import Codec, Plan, Reply, Request


class Turn:
    """One request under way."""

    __slots__ = ("deadline", "echoes", "looked", "replies", "request", "run", "sent_at", "sent_by", "skipped", "torn")

    def __init__(self, request: Request[Any], *, sent_at: float, sent_by: float, deadline: float) -> None:
        self.request = request
        self.sent_at = sent_at
        """When its first byte left."""
        self.sent_by = sent_by
        """When its last byte has left."""
        self.deadline = deadline
        self.run: Run | None = None
        """Whose turn it is, where others may follow before it ends."""
        self.replies: list[Any] = []
        self.echoes = 0
        self.looked = False
        """The line was looked at once more after the deadline."""
        self.skipped = -1
        """What the codec had skipped when the last frame was heard; before the first frame anything may be skipped."""
        self.torn: set[int] = set()
        """Nodes whose answer was followed by bytes that are no frame."""

    def offer(self, reply: Reply) -> bool:
        """Take a valid frame; False: it is a stray."""
        if reply.frame == self.request.frame and not self.request.mirrored:
            self.echoes += 1
            return True
        if len(self.replies) >= self.request.replies or not self.request.answers(reply):
            return False
        if self.replies and any(earlier.node == reply.node for earlier in self.replies):
            return False
        if reply.node in self.torn:
            return False
        self.replies.append(reply)
        return True

    def tear(self) -> None:
        """What stands behind the last answer is no frame."""
        if self.replies:
            self.torn.add(self.replies.pop().node)

    def complete(self) -> bool:
        return len(self.replies) == self.request.replies

    def missing(self) -> list[int]:
        """Nodes whose answer has not come."""
        heard = {reply.node for reply in self.replies}
        return [node for node in self.request.nodes if node not in heard]


class Finished(Exception):
    """The job's plan returned."""

    def __init__(self, value: Any) -> None:
        super().__init__()
        self.value = value


class Run:
    """A job that has begun: which request is next. A recovery can be put before any request; its end leads back to it."""

    __slots__ = ("_detour", "_resume", "attempts", "estop", "job", "recovering", "request")

    def __init__(self, job: Job, *, estop: bool = False) -> None:
        self.job = job
        self.estop = estop
        self.attempts = job.attempts
        """Times the present request was said in vain."""
        self.recovering = job.recovery
        self._detour: Plan[bool] | None = None
        self._resume: tuple[Request[Any], int] | None = None
        self.request: Request[Any]

    @property
    def simple(self) -> bool:
        """One request and nothing around it."""
        return self.job.plan is None and self._detour is None

    @property
    def single(self) -> bool:
        """One request that one node answers, and nothing around it: others may be said before it is answered."""
        return self.simple and not self.recovering and len(self.request.nodes) == self.request.replies == 1

    def begin(self) -> None:
        """Find the first request. Raises Finished, or the plan's error."""
        if self.job.request is not None:
            self.request = self.job.request
        else:
            assert self.job.plan is not None
            self.request = _step(self.job.plan, None)

    def detour(self, recovery: Plan[bool]) -> bool | None:
        """Recover the node first, then say the present request. Returns and raises as `succeed`."""
        self._resume, self._detour, self.recovering = (self.request, self.attempts), recovery, True
        return self._along(_step, None)

    def succeed(self, value: Any) -> bool | None:
        """The present request has its value. Returns whether the node kept its state, when a detour ended with this, else None.
        Raises Finished when the job has its result, or the plan's own error."""
        if self._detour is not None:
            return self._along(_step, value)
        self.attempts = 0
        if self.job.plan is None:
            raise Finished(value)
        self.request = _step(self.job.plan, value)
        return None

    def fail(self, error: Exception, *, offline: bool = False) -> bool | None:
        """The present request is given up. Returns and raises as `succeed`. An unanswered detour costs the request one of its
        tries, all of them when the node is offline."""
        if self._detour is not None:
            return self._along(_throw, error, last=offline)
        self._give_up(error)
        return None

    def _along(self, step: Callable[[Plan[bool], Any], Request[Any]], value: Any, *, last: bool = False) -> bool | None:
        """One step of the detour, or from its end back to the request."""
        assert self._detour is not None
        self.attempts = 0
        try:
            self.request = step(self._detour, value)
        except Finished as end:
            self._leave_detour()
            return bool(end.value)
        except Exception as error:  # noqa: BLE001 - whatever it is, the job is told
            self._leave_detour()
            self.attempts += 1
            if last or self.attempts >= self.job.tries or not isinstance(error, ReplyTimeout):
                self._give_up(error)
        return None

    def _give_up(self, error: Exception) -> None:
        self.attempts = 0
        if self.job.plan is None:
            raise error
        self.request = _throw(self.job.plan, error)

    def _leave_detour(self) -> None:
        assert self._resume is not None
        (self.request, self.attempts), self._detour, self._resume, self.recovering = self._resume, None, None, self.job.recovery


def _step(plan: Plan[Any], value: Any) -> Request[Any]:
    try:
        return plan.send(value)
    except StopIteration as stop:
        raise Finished(stop.value) from None


def _throw(plan: Plan[Any], error: Exception) -> Request[Any]:
    try:
        return plan.throw(error)
    except StopIteration as stop:
        raise Finished(stop.value) from None


def judge(codec: Codec, turn: Turn, strays: list[Reply], following: Sequence[Turn] = ()) -> bool:
    """Hear out what the codec holds for the oldest turn under way and those that follow. True: the turn has all its answers, and
    the window ends with a whole frame, or with the beginning of an answer that is still due."""
    while (reply := codec.next_reply()) is not None:
        if codec.skipped != turn.skipped:
            turn.tear()
            turn.skipped = codec.skipped
        if not (turn.offer(reply) or (following and any(other.offer(reply) for other in following))):
            strays.append(reply)
    return turn.complete() and codec.skipped == turn.skipped and (bool(following) or not codec.pending)
