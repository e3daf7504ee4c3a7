"""The scheduler: who goes next, that nobody starves, and that whatever was accepted ends exactly once."""

from __future__ import annotations

import random
from collections import Counter
from typing import Any

import pytest

from servobus.bus.health import FIRST_DEADLINE
from servobus.bus.queue import Callback, Job
from servobus.bus.scheduler import POLL_PATIENCE, PollTimer
from servobus.errors import ActionWithheld, EStopped, GoalExpired, LinkDown, NotEnabled, NotSupported, Overloaded, ReplyTimeout
from servobus.protocols.base import Outcome, run_plan
from tests.bus.toy import ANSWER, READ, Bench, Sink, group_read, poll, read, shout, ticket

Ended = list[tuple[str, Any]]


def job(node: int, *, expires: float = 10.0, motion: bool = False, urgent: bool = False, session: object = None) -> Job:
    return Job(Sink(), expires, request=read(node), motion=motion, urgent=urgent, session=session)


def sink(of: Job) -> Sink:
    assert isinstance(of.sink, Sink)
    return of.sink


def kind(bench: Bench, taken: Job | None) -> str:
    if taken is None:
        return "-"
    if taken.recovery:
        return "probe"
    if taken.plan is not None:
        return "goal" if taken.motion else "estop"
    return "poll" if taken.sink.done or isinstance(taken.sink, Callback) and taken.tries == 1 else "request"


def finish(taken: Job) -> Any:
    """Let a plan run to its end, as a line that answers would."""
    assert taken.plan is not None
    value = run_plan(taken.plan, lambda request: None)
    taken.succeed(value)
    return value
