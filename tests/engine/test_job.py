"""How a job goes from request to request."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import pytest

from servobus.engine.queue import Job
from servobus.engine.turn import Finished, Run
from servobus.errors import DeviceError, ReplyTimeout, ServobusError
from servobus.protocols.base import Plan
from tests.engine.toy_protocol import Sink, read

# Runs


def run_of(plan: Plan[Any] | None = None, *, recovery: bool = False, tries: int = 3) -> Run:
    job = Job(Sink(), 1.0, request=read(1) if plan is None else None, plan=plan, recovery=recovery, tries=tries)
    run = Run(job)
    run.begin()
    return run


def two_steps() -> Plan[tuple[Any, Any]]:
    first = yield read(1, 10)
    second = yield read(1, 11)
    return first, second


def careful() -> Plan[str]:
    """Survives what goes wrong, and tells it."""
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


def register(run: Run) -> int:
    return run.request.frame[4]


def test_a_single_request_ends_its_job_with_its_value() -> None:
    run = run_of()
    assert run.simple
    assert register(run) == 0
    with pytest.raises(Finished) as end:
        run.succeed(7)
    assert end.value.value == 7


def test_a_plan_goes_from_request_to_request_and_returns() -> None:
    run = run_of(two_steps())
    assert not run.simple
    assert register(run) == 10
    run.attempts = 2
    assert run.succeed("a") is None
    assert (register(run), run.attempts) == (11, 0)
    with pytest.raises(Finished) as end:
        run.succeed("b")
    assert end.value.value == ("a", "b")


def test_a_plan_may_have_nothing_to_ask() -> None:
    def nothing() -> Plan[str]:
        yield from ()
        return "done"

    with pytest.raises(Finished) as end:
        run_of(nothing())
    assert end.value.value == "done"


@pytest.mark.parametrize("plan", [None, two_steps])
def test_an_error_ends_a_job_that_does_not_handle_it(plan: Any) -> None:
    run = run_of(plan and plan())
    error = DeviceError("no")
    with pytest.raises(DeviceError) as caught:
        run.fail(error)
    assert caught.value is error


def test_an_error_a_plan_handles_leads_on() -> None:
    run = run_of(careful())
    run.attempts = 2
    assert run.fail(DeviceError("no")) is None
    assert (register(run), run.attempts) == (12, 0)
    with pytest.raises(Finished) as end:
        run.succeed(0)
    assert end.value.value == "after DeviceError"


def test_a_plan_may_end_well_by_an_error() -> None:
    def shrug() -> Plan[str]:
        try:
            yield read(1)
        except ServobusError:
            return "never mind"
        return "well"

    run = run_of(shrug())
    with pytest.raises(Finished) as end:
        run.fail(ReplyTimeout("gone"))
    assert end.value.value == "never mind"


@pytest.mark.parametrize("kept", [True, False])
@pytest.mark.parametrize("plan", [None, two_steps])
def test_a_detour_leads_back_to_the_request_and_its_attempts(plan: Any, kept: bool) -> None:
    run = run_of(plan and plan())
    before, run.attempts = register(run), 2
    assert run.detour(fence(kept)) is None
    assert (register(run), run.attempts, run.recovering, run.simple) == (20, 0, True, False)
    assert run.succeed("fence") is kept
    assert (register(run), run.attempts, run.recovering) == (before, 2, False)
    assert run.simple is (plan is None)


def test_a_detour_with_nothing_to_ask_is_over_at_once() -> None:
    def nothing() -> Plan[bool]:
        yield from ()
        return False

    run = run_of()
    assert run.detour(nothing()) is False
    assert (register(run), run.recovering) == (0, False)


def test_a_detour_may_go_on_after_an_error() -> None:
    run = run_of()
    run.detour(twofold_fence())
    assert run.fail(ReplyTimeout("gone")) is None
    assert (register(run), run.recovering) == (21, True)
    assert run.succeed(0) is True


def test_a_detour_may_end_well_by_an_error() -> None:
    def shrug() -> Plan[bool]:
        try:
            yield read(1, 20)
        except ServobusError:
            return False
        return True

    run = run_of()
    run.detour(shrug())
    assert run.fail(ReplyTimeout("gone")) is False
    assert register(run) == 0


def test_an_unanswered_detour_costs_one_try_and_the_last_one_the_job() -> None:
    run = run_of(tries=2)
    run.detour(fence())
    assert run.fail(ReplyTimeout("gone")) is None
    assert (register(run), run.attempts, run.recovering) == (0, 1, False)
    run.detour(fence())
    with pytest.raises(ReplyTimeout):
        run.fail(ReplyTimeout("gone"))


def test_a_detour_to_an_offline_node_costs_all_tries() -> None:
    run = run_of(careful())
    run.detour(fence())
    run.fail(ReplyTimeout("gone"), offline=True)
    assert (register(run), run.attempts) == (12, 0), "the plan was told, and goes its own way"


@pytest.mark.parametrize("ends", ["by its value", "by an error"])
def test_a_detour_that_finds_something_wrong_tells_the_plan(ends: str) -> None:
    def wrong() -> Plan[bool]:
        with suppress(ReplyTimeout):
            yield read(1, 20)
        raise DeviceError("two servos with this id")

    run = run_of(careful())
    run.detour(wrong())
    if ends == "by its value":
        run.succeed(0)
    else:
        run.fail(ReplyTimeout("gone"))
    assert register(run) == 12
    with pytest.raises(Finished) as end:
        run.succeed(0)
    assert end.value.value == "after DeviceError"


def test_a_recovery_stays_one_to_its_end() -> None:
    run = run_of(fence(), recovery=True)
    assert run.recovering
    with pytest.raises(Finished):
        run.succeed(0)


def test_a_job_that_was_begun_before_goes_on_counting() -> None:
    job = Job(Sink(), 1.0, request=read(1))
    job.attempts = 2
    assert Run(job).attempts == 2
