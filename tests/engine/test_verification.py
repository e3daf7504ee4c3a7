"""Before a goal leaves, its servo is known to be as it was left: the verification of the scheduler, without a line."""

from __future__ import annotations

from typing import Any

import pytest

from servobus.engine.job import Job, Send
from servobus.engine.scheduler import PROBE_PAUSE
from servobus.engine.verification import MAX_AGE, MIN_AGE, PASS
from servobus.errors import ReplyTimeout
from servobus.protocols.base import run_plan
from servobus.values import Loss, Outcome
from tests.engine.scheduled_jobs import job
from tests.engine.toy_protocol import RESTARTED, Bench, ticket


def bench() -> Bench:
    made = Bench(1, 2, 3)
    made.driver.verifies = True
    return made


def run(job: Job | None, answer: int = 0) -> list[int]:
    """Carry a job out; every read brings `answer`. Returns the nodes asked."""
    assert job is not None
    assert job.plan is not None
    asked: list[int] = []

    def exchange(request: Any) -> int:
        asked.append(request.node)
        return answer

    job.succeed(run_plan(job.plan, exchange))
    return asked


def test_a_goal_waits_for_the_verification_of_its_servo() -> None:
    rig, ended = bench(), []  # type: ignore[var-annotated]
    rig.coalescer.put(ticket(1, ended))
    assert run(rig.scheduler.next_job(0.0)) == [1], "first the servo is asked"
    goals = rig.scheduler.next_job(0.001)
    assert run(goals) == [255], "then the goal leaves"
    assert ended == [("s1", Outcome.SENT)]
    assert rig.scheduler.goals.turns == 1, "a verification is no goal turn"


def test_one_question_verifies_all_servos_of_a_group() -> None:
    rig, ended = bench(), []  # type: ignore[var-annotated]
    for number in (1, 2, 3):
        rig.coalescer.put(ticket(number, ended, batch=1))
    rig.scheduler.goals.verification.confirm("s2", 0.0)
    assert run(rig.scheduler.next_job(0.01)) == [1, 2, 3], "s2 was shown lately; it is asked with the others, for nothing more"
    assert run(rig.scheduler.next_job(0.02)) == [255]
    assert len(ended) == 3


def test_a_servo_that_a_reply_showed_lately_is_not_asked() -> None:
    rig, ended = bench(), []  # type: ignore[var-annotated]
    rig.scheduler.goals.verification.confirm("s1", 1.0)
    rig.coalescer.put(ticket(1, ended, expires=9.0))
    assert run(rig.scheduler.next_job(1.0 + 0.9 * MIN_AGE)) == [255]
    rig.coalescer.put(ticket(1, ended, expires=9.0))
    assert run(rig.scheduler.next_job(1.0 + MIN_AGE)) == [1]


def test_a_servo_that_was_doubtful_is_asked_again() -> None:
    rig, ended = bench(), []  # type: ignore[var-annotated]
    rig.scheduler.goals.verification.confirm("s1", 0.0)
    rig.scheduler.goals.verification.forget(["s1"])
    rig.coalescer.put(ticket(1, ended))
    assert run(rig.scheduler.next_job(0.0)) == [1]


def test_a_servo_that_has_restarted_is_reported_and_the_others_go() -> None:
    rig, ended = bench(), []  # type: ignore[var-annotated]
    rig.coalescer.put(ticket(1, ended))
    run(rig.scheduler.next_job(0.0), RESTARTED)
    assert rig.losses == [("s1", Loss.RESTARTED)]
    assert ended == [], "the bus disables the servo, and that ends its goals"


def test_a_slow_turn_of_another_class_costs_no_second_verification() -> None:
    rig, ended = bench(), []  # type: ignore[var-annotated]
    rig.coalescer.put(ticket(1, ended, expires=9.0))
    run(rig.scheduler.next_job(0.0))
    rig.scheduler.queue(job(2), 0.0)
    assert isinstance(rig.scheduler.next_job(0.0), Job)
    assert run(rig.scheduler.next_job(4 * MIN_AGE)) == [255]
    rig.coalescer.put(ticket(1, ended, expires=9.0))
    assert run(rig.scheduler.next_job(MAX_AGE)) == [1], "it counts from when it was asked for"


def test_a_stream_of_goals_is_verified_once_in_a_while() -> None:
    rig, ended, asked = bench(), [], []  # type: ignore[var-annotated]
    for number in range(100):
        rig.coalescer.put(ticket(1, ended, expires=9.0))
        now = number * MIN_AGE / 10
        asked += run(rig.scheduler.next_job(now))
        if asked[-1] == 1:
            asked += run(rig.scheduler.next_job(now))
    assert asked.count(255) == 100
    assert asked.count(1) in (10, 11)


def test_a_verification_that_no_goal_used_counts_no_longer() -> None:
    rig, ended = bench(), []  # type: ignore[var-annotated]
    rig.coalescer.put(ticket(1, ended, expires=9.0))
    run(rig.scheduler.next_job(0.0))
    assert run(rig.scheduler.next_job(2 * PASS)) == [1]


def test_a_verification_without_a_reply_lets_nothing_pass() -> None:
    rig, ended = bench(), []  # type: ignore[var-annotated]
    rig.coalescer.put(ticket(1, ended, expires=9.0))
    check = rig.scheduler.next_job(0.0)
    assert check is not None
    assert isinstance(check.begin(), Send)
    check.fail(ReplyTimeout("no answer"))
    assert run(rig.scheduler.next_job(PROBE_PAUSE)) == [1]


def test_on_a_slow_line_servos_are_verified_less_often() -> None:
    rig, ended = bench(), []  # type: ignore[var-annotated]
    for begun in (0.0, 1.0):
        rig.coalescer.put(ticket(1, ended, expires=9.0))
        run(rig.scheduler.next_job(begun))
        assert run(rig.scheduler.next_job(begun + 0.03)) == [255]
    assert rig.scheduler.goals.verification.max_age == pytest.approx(0.15)
    assert rig.scheduler.goals.verification.max_age <= MAX_AGE
