"""How a job goes from request to request."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import pytest

from servobus.engine.job import Done, Failed, Job, JobKind, NodeRestarted, Send
from servobus.errors import DeviceError, ReplyTimeout, ServobusError
from servobus.protocols.base import Plan
from tests.engine.toy_protocol import Sink, read


def begun(plan: Plan[Any] | None = None, *, kind: JobKind = JobKind.ORDINARY, tries: int = 3) -> Job:
    job = Job(Sink(), 1.0, request=read(1) if plan is None else None, plan=plan, kind=kind, tries=tries)
    assert isinstance(job.begin(), Send)
    return job


def two_steps() -> Plan[tuple[Any, Any]]:
    first = yield read(1, 10)
    second = yield read(1, 11)
    return first, second


def careful() -> Plan[str]:
    """Handles the error of its first request."""
    try:
        yield read(1, 10)
    except ServobusError as error:
        yield read(1, 12)
        return f"after {type(error).__name__}"
    return "well"


def fence(value: bool = True) -> Plan[bool]:
    yield read(1, 20)
    return value


def twofold_fence() -> Plan[bool]:
    """Asks in another way when the first is not answered."""
    try:
        yield read(1, 20)
    except ServobusError:
        yield read(1, 21)
    return True


def register(job: Job) -> int:
    return job.request.frame[4]


def test_a_request_ends_its_job_with_its_value() -> None:
    job = begun()
    assert job.plain
    assert register(job) == 0
    assert job.advance(7) == Done(7)


def test_a_plan_goes_from_request_to_request_and_returns() -> None:
    job = begun(two_steps())
    assert not job.plain
    assert register(job) == 10
    job.attempts = 2
    assert job.advance("a") == Send(job.request)
    assert (register(job), job.attempts) == (11, 0)
    assert job.advance("b") == Done(("a", "b"))


def test_a_plan_may_have_nothing_to_ask() -> None:
    def nothing() -> Plan[str]:
        yield from ()
        return "done"

    assert Job(Sink(), 1.0, plan=nothing()).begin() == Done("done")


@pytest.mark.parametrize("plan", [None, two_steps])
def test_an_error_ends_a_job_that_does_not_handle_it(plan: Any) -> None:
    job = begun(plan and plan())
    error = DeviceError("no")
    assert job.give_up(error) == Failed(error)


def test_a_plan_goes_on_after_an_error_that_it_handles() -> None:
    job = begun(careful())
    job.attempts = 2
    assert job.give_up(DeviceError("no")) == Send(job.request)
    assert (register(job), job.attempts) == (12, 0)
    assert job.advance(0) == Done("after DeviceError")


def test_a_plan_may_end_well_by_an_error() -> None:
    def shrug() -> Plan[str]:
        try:
            yield read(1)
        except ServobusError:
            return "never mind"
        return "well"

    assert begun(shrug()).give_up(ReplyTimeout("gone")) == Done("never mind")


def test_a_mistake_in_a_plan_is_a_failed_step() -> None:
    def wrong() -> Plan[None]:
        yield read(1)
        raise KeyError("a mistake")

    step = begun(wrong()).advance(0)
    assert isinstance(step, Failed)
    assert isinstance(step.error, KeyError)


@pytest.mark.parametrize("kept", [True, False])
@pytest.mark.parametrize("plan", [None, two_steps])
def test_a_fence_leads_back_to_the_request_and_its_attempts(plan: Any, kept: bool) -> None:
    job = begun(plan and plan())
    before, job.attempts = register(job), 2
    assert job.put_fence(fence(kept)) == Send(job.request)
    assert (register(job), job.attempts, job.fencing, job.plain) == (20, 0, True, False)
    step = job.advance("fence")
    assert step == (Send if kept else NodeRestarted)(job.request)
    assert isinstance(step, NodeRestarted) is not kept
    assert (register(job), job.attempts, job.fencing) == (before, 2, False)
    assert job.plain is (plan is None)


def test_a_fence_with_nothing_to_ask_is_over_at_once() -> None:
    def nothing() -> Plan[bool]:
        yield from ()
        return False

    job = begun()
    assert isinstance(job.put_fence(nothing()), NodeRestarted)
    assert (register(job), job.fencing) == (0, False)


def test_a_fence_may_go_on_after_an_error() -> None:
    job = begun()
    job.put_fence(twofold_fence())
    assert job.give_up(ReplyTimeout("gone")) == Send(job.request)
    assert (register(job), job.fencing) == (21, True)
    assert isinstance(job.advance(0), Send)
    assert not job.fencing


def test_a_fence_may_end_well_by_an_error() -> None:
    def shrug() -> Plan[bool]:
        try:
            yield read(1, 20)
        except ServobusError:
            return False
        return True

    job = begun()
    job.put_fence(shrug())
    assert isinstance(job.give_up(ReplyTimeout("gone")), NodeRestarted)
    assert register(job) == 0


def test_an_unanswered_fence_costs_one_try_and_the_last_one_the_job() -> None:
    job = begun(tries=2)
    job.put_fence(fence())
    assert isinstance(job.give_up(ReplyTimeout("gone")), Send)
    assert (register(job), job.attempts, job.fencing) == (0, 1, False)
    job.put_fence(fence())
    step = job.give_up(ReplyTimeout("gone"))
    assert isinstance(step, Failed)
    assert isinstance(step.error, ReplyTimeout)


def test_an_unanswered_fence_of_an_offline_node_costs_all_tries() -> None:
    job = begun(careful())
    job.put_fence(fence())
    job.give_up(ReplyTimeout("gone"), offline=True)
    assert (register(job), job.attempts) == (12, 0), "the plan has the error, and decides itself what follows"


@pytest.mark.parametrize("ends", ["by its value", "by an error"])
def test_a_fence_that_finds_something_wrong_fails_the_request(ends: str) -> None:
    def wrong() -> Plan[bool]:
        with suppress(ReplyTimeout):
            yield read(1, 20)
        raise DeviceError("two servos with this id")

    job = begun(careful())
    job.put_fence(wrong())
    if ends == "by its value":
        job.advance(0)
    else:
        job.give_up(ReplyTimeout("gone"))
    assert register(job) == 12
    assert job.advance(0) == Done("after DeviceError")


def test_a_probe_is_a_fence_to_its_end() -> None:
    job = begun(fence(), kind=JobKind.PROBE)
    assert job.fencing
    assert job.advance(0) == Done(True)


def test_a_job_that_begins_again_goes_on_counting() -> None:
    job = Job(Sink(), 1.0, request=read(1))
    job.attempts = 2
    assert job.begin() == Send(job.request)
    assert job.attempts == 2
