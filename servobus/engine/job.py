"""A job: one request, or one plan of several, with its place in the queue, its tries, its deadline and its future. Pure.

The engine asks a job for one step after another. Each step is a value, never an exception:

* `Send(request)`: this request is next on the line.
* `NodeRestarted(request)`: the fence showed that the node has restarted. What would move it ends here; any other job
  goes on with this request.
* `Done(value)`, `Failed(error)`: the job has its result.

A fence can be put before any request of a job. The cases when it ends:

1. It was answered: the request follows, with the tries it had used before.
2. It was not answered: that costs the request one try, or all of them if the node is offline by now.
3. It raised something other than ReplyTimeout (two servos with one id, a mistake in a driver): the request fails.

A request that fails ends a plain job. A plan has the error thrown into it and decides itself what follows.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum, auto
from typing import Any, NamedTuple, Protocol, TypeAlias

from servobus.engine.stats import Cause
from servobus.errors import ReplyTimeout
from servobus.protocols.base import Plan, Request

TRIES = 3


class Send(NamedTuple):
    request: Request[Any]


class NodeRestarted(NamedTuple):
    request: Request[Any]


class Done(NamedTuple):
    value: Any


class Failed(NamedTuple):
    error: Exception


Step: TypeAlias = Send | NodeRestarted | Done | Failed


class JobKind(Enum):
    """What decides how the engine treats a job."""

    ORDINARY = auto()
    """Reads, settings, identification."""
    MOTION = auto()
    """Moves something: dropped by an e-stop, and refused after a restart of its node."""
    ESTOP = auto()
    """Comes between the frames of any other plan."""
    PROBE = auto()
    """Its plan is a fence itself, so none comes before it."""


class Sink(Protocol):
    """Where the result goes; an asyncio.Future is one."""

    def done(self) -> bool:
        """Return whether the caller has left: then the job need not begin."""

    def set_result(self, value: Any, /) -> None: ...

    def set_exception(self, error: BaseException, /) -> None: ...


class Callback:
    """A sink that calls back with the value or the error: for jobs that no caller awaits."""

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
    """One request, or one plan whose frames only an e-stop parts."""

    __slots__ = (
        "_fence",
        "_resume",
        "attempts",
        "cause",
        "changes",
        "even_if_offline",
        "expires",
        "fencing",
        "kind",
        "node",
        "plan",
        "request",
        "session",
        "sink",
        "tries",
    )

    request: Request[Any]
    _resume: tuple[Request[Any], int]
    """The request behind the fence, and its attempts."""

    def __init__(
        self,
        sink: Sink,
        expires: float,
        request: Request[Any] | None = None,
        plan: Plan[Any] | None = None,
        node: int = 0,
        kind: JobKind = JobKind.ORDINARY,
        even_if_offline: bool = False,
        session: object = None,
        tries: int = TRIES,
    ) -> None:
        self.sink = sink
        self.expires = expires
        self.plan = plan
        """None: a plain job of one request."""
        if request is not None:
            self.request = request
            """The request that is next or under way; a plan has one only after `begin`."""
            self.node = request.node
        else:
            self.node = node
        self.kind = kind
        self.even_if_offline = even_if_offline
        """It begins even while its node is offline: ping."""
        self.session = session
        """The exclusive session it belongs to."""
        self.tries = tries
        """How often one of its idempotent requests may be sent."""
        self.attempts = 0
        """How often the present request was sent in vain."""
        self.changes = request is not None and request.changes
        """It has asked for a change, which may be done where it fails."""
        self.cause: Cause | None = None
        """Why its present request has no value yet."""
        self.fencing = kind is JobKind.PROBE
        """Its present request belongs to a fence."""
        self._fence: Plan[bool] | None = None

    # Its result

    def succeed(self, value: Any) -> None:
        if not self.sink.done():
            self.sink.set_result(value)

    def fail(self, error: BaseException) -> None:
        """End the job. A plan that did not run to its end is closed, so that its cleanup code runs."""
        if self.plan is not None:
            self.plan.close()
        if not self.sink.done():
            self.sink.set_exception(error)

    # Its steps

    @property
    def plain(self) -> bool:
        """One request, and no fence is under way before it."""
        return self.plan is None and not self.fencing

    @property
    def applied(self) -> str:
        """The end of a message about a job that was begun: whether it may have changed something."""
        return "; it may have been applied" if self.changes else ""

    def begin(self) -> Step:
        """Return the first step."""
        return Send(self.request) if self.plan is None else self._in_plan(_send(self.plan, None))

    def put_fence(self, fence: Plan[bool]) -> Step:
        """Put a fence before the present request."""
        self._fence, self._resume, self.fencing = fence, (self.request, self.attempts), True
        return self._in_fence(_send(fence, None))

    def advance(self, value: Any) -> Step:
        """Return the step after the present request brought this value."""
        if self._fence is not None:
            return self._in_fence(_send(self._fence, value))
        return Done(value) if self.plan is None else self._in_plan(_send(self.plan, value))

    def give_up(self, error: Exception, *, offline: bool = False) -> Step:
        """Return the step after the present request failed. `offline`: its node is offline, so a fence is not repeated."""
        if self._fence is not None:
            return self._in_fence(_throw(self._fence, error), last=offline)
        return Failed(error) if self.plan is None else self._in_plan(_throw(self.plan, error))

    def _in_plan(self, step: Step) -> Step:
        self.attempts, self.cause = 0, None
        if isinstance(step, Send):
            self.request = request = step.request
            self.changes = self.changes or request.changes
        return step

    def _in_fence(self, step: Step, *, last: bool = False) -> Step:
        """Apply a step of the fence; see the cases above."""
        if isinstance(step, Send):
            self.request, self.attempts = step.request, 0
            return step
        self.request, self.attempts = self._resume
        self._fence, self.fencing = None, self.kind is JobKind.PROBE
        if isinstance(step, Failed):
            self.attempts += 1
            if last or self.attempts >= self.tries or not isinstance(step.error, ReplyTimeout):
                return self.give_up(step.error)
        elif isinstance(step, Done) and not step.value:
            return NodeRestarted(self.request)
        return Send(self.request)


def _send(plan: Plan[Any], value: Any) -> Step:
    try:
        return Send(plan.send(value))
    except StopIteration as stop:
        return Done(stop.value)
    except Exception as error:  # noqa: BLE001 - a mistake in a driver ends its job, never the bus
        return Failed(error)


def _throw(plan: Plan[Any], error: Exception) -> Step:
    try:
        return Send(plan.throw(error))
    except StopIteration as stop:
        return Done(stop.value)
    except Exception as raised:  # noqa: BLE001 - a mistake in a driver ends its job, never the bus
        return Failed(raised)
