"""The scheduler and what goes to one servo: goals of a tick, split groups, nodes that are in doubt or gone."""

from __future__ import annotations

import pytest

from servobus.engine.health import FIRST_ALLOWANCE
from servobus.errors import ActionWithheld, GoalExpired, NotEnabled, NotSupported, Overloaded, ReplyTimeout
from servobus.values import Outcome
from tests.engine.scheduled_jobs import Ended, disabled, finish, job, kind, results, split_bench, stop_job
from tests.engine.toy_protocol import ANSWER, READ, Bench, Sink, read, ticket

# Goals


def test_goals_of_one_tick_are_one_plan_and_each_gets_its_outcome() -> None:
    bench, ended = Bench(), Ended()
    for number in (1, 2, 3):
        bench.coalescer.put(ticket(number, ended))
    finish(bench.scheduler.next_job(0.0))
    assert ended == [("s1", Outcome.SENT), ("s2", Outcome.SENT), ("s3", Outcome.SENT)]
    assert bench.scheduler.goals.split_groups == 0


def test_one_error_ends_all_goals_of_its_turn() -> None:
    bench, ended = Bench(), Ended()
    bench.coalescer.put(ticket(1, ended))
    bench.coalescer.put(ticket(2, ended))
    taken = bench.scheduler.next_job(0.0)
    assert taken is not None
    error = ReplyTimeout("gone")
    taken.fail(error)
    assert ended == [("s1", error), ("s2", error)]


@pytest.mark.parametrize("refusal", [NotSupported("no such kind"), KeyError("a mistake in a driver")])
def test_goals_the_driver_refuses_end_with_its_error_and_the_next_go_on(refusal: Exception) -> None:
    bench, ended = Bench(), Ended()
    bench.driver.refusal = refusal
    bench.coalescer.put(ticket(1, ended))
    bench.coalescer.put(ticket(2, ended, confirm=True))
    assert bench.scheduler.next_job(0.0) is None
    assert ended == [("s1", refusal), ("s2", refusal)]
    bench.driver.refusal = None
    bench.coalescer.put(ticket(1, ended))
    assert kind(bench.scheduler.next_job(0.0)) == "goal"


def test_the_frames_of_a_split_group_leave_one_after_the_other_with_a_lower_turn_between() -> None:
    ended: Ended = []
    bench, first = split_bench(ended)
    bench.scheduler.queue(job(1), 0.0)
    finish(first)
    assert kind(bench.scheduler.next_job(0.0)) == "request"
    finish(bench.scheduler.next_job(0.0))
    finish(bench.scheduler.next_job(0.0))
    assert [servo for servo, _ in ended] == ["s1", "s2", "s3"]


def test_a_frame_that_waited_too_long_is_not_sent() -> None:
    ended: Ended = []
    bench, first = split_bench(ended, expires=1.0)
    finish(first)
    assert bench.scheduler.next_job(1.0) is None
    assert [(servo, type(result)) for servo, result in ended[1:]] == [("s2", GoalExpired), ("s3", GoalExpired)]


def test_a_frame_whose_caller_left_is_not_sent() -> None:
    ended: Ended = []
    left: list[bool] = []
    bench, _ = split_bench(ended, gone=lambda: bool(left))
    left.append(True)
    assert bench.scheduler.next_job(0.0) is None
    assert (ended, bench.scheduler.waiting()) == ([], 0)


def test_a_frame_whose_servo_is_in_doubt_waits_and_newer_goals_replace_it() -> None:
    ended: Ended = []
    bench, first = split_bench(ended)
    finish(first)
    bench.nodes.missed(bench.node(2), READ | ANSWER, 0.0, 5.0)
    bench.coalescer.put(ticket(3, ended))
    third = bench.scheduler.next_job(0.1)
    finish(third)
    assert ended[1:] == [("s3", Outcome.SENT)], "the planned one, which was before the newer"
    finish(bench.scheduler.next_job(0.1))
    assert ended[2:] == [("s3", Outcome.SENT)]
    assert bench.scheduler.next_job(0.1) is None
    bench.nodes.fenced(bench.node(2))
    finish(bench.scheduler.next_job(0.1))
    assert ended[3:] == [("s2", Outcome.SENT)]


def test_a_disabled_servo_gets_no_goal_that_was_planned_already() -> None:
    ended: Ended = []
    bench, _ = split_bench(ended)
    bench.scheduler.drop_goals(disabled, {"s2"})
    assert [(servo, type(result)) for servo, result in ended] == [("s2", NotEnabled)]
    finish(bench.scheduler.next_job(0.0))
    assert ended[1:] == [("s3", Outcome.SENT)]
    assert bench.scheduler.next_job(0.0) is None


def test_a_group_asked_for_together_is_never_sent_without_one_of_it() -> None:
    bench, ended = Bench(1, 2, 3), Ended()
    for number in (1, 2):
        bench.coalescer.put(ticket(number, ended, batch=1))
    bench.scheduler.drop_goals(disabled, {"s1"})
    assert [(servo, type(result)) for servo, result in ended] == [("s1", NotEnabled), ("s2", ActionWithheld)]
    assert bench.scheduler.next_job(0.0) is None


# Requests and nodes


def test_overload_comes_at_exactly_the_limit() -> None:
    bench = Bench(1, 2, limit=2)
    bench.scheduler.queue(job(1), 0.0)
    bench.scheduler.queue(job(1), 0.0)
    with pytest.raises(Overloaded):
        bench.scheduler.queue(job(2), 0.0)
    assert bench.scheduler.waiting() == 2
    assert bench.scheduler.next_job(0.0) is not None
    bench.scheduler.queue(job(2), 0.0)


def test_requests_for_an_offline_node_wait_aside_as_long_as_an_answer_would_take() -> None:
    bench = Bench(1, 2, limit=2)
    bench.take_offline(1)
    waiting = [job(1), job(1)]
    for each in waiting:
        bench.scheduler.queue(each, 0.0)
    with pytest.raises(Overloaded):
        bench.scheduler.queue(job(1), 0.0)
    bench.scheduler.queue(other := job(2), 0.0)
    assert bench.scheduler.wake() == FIRST_ALLOWANCE
    assert bench.scheduler.next_job(FIRST_ALLOWANCE - 0.001) is other
    assert [results(each) for each in waiting] == [[], []]
    bench.scheduler.expire(FIRST_ALLOWANCE)
    for each in waiting:
        (error,) = results(each)
        assert isinstance(error, ReplyTimeout)
        assert "offline" in str(error)
        assert error.raw == read(1).frame
    assert bench.scheduler.waiting() == 0


def test_a_busy_line_ends_them_in_time_too() -> None:
    bench = Bench(1, 2)
    bench.take_offline(1)
    waiting, plan_job = job(1), stop_job()
    bench.scheduler.queue(waiting, 0.0)
    bench.scheduler.queue(plan_job, 0.0)
    for _ in range(3):
        bench.scheduler.queue(job(2), 0.0)
    assert kind(bench.scheduler.next_job(FIRST_ALLOWANCE)) == "request"
    assert len(results(waiting)) == len(results(plan_job)) == 1


def test_they_are_served_in_order_when_the_node_comes_back() -> None:
    bench = Bench(1, 2)
    queued = [job(1), job(1)]
    for each in queued:
        bench.scheduler.queue(each, 0.0)
    bench.take_offline(1)
    parked = job(1)
    bench.scheduler.queue(parked, 0.0)
    assert bench.scheduler.next_job(0.001) is None
    bench.nodes.fenced(bench.node(1))
    assert [bench.scheduler.next_job(0.001) for _ in range(3)] == [*queued, parked]


def test_what_was_queued_when_its_node_went_offline_does_not_wait_longer_than_what_comes_then() -> None:
    bench = Bench(1)
    queued = job(1, expires=2.0)
    bench.scheduler.queue(queued, 0.0)
    bench.take_offline(1, now=0.5)
    assert bench.scheduler.wake() == pytest.approx(0.5 + FIRST_ALLOWANCE)
    bench.scheduler.expire(0.5 + FIRST_ALLOWANCE)
    assert isinstance(results(queued)[0], ReplyTimeout)


def test_a_job_marked_even_if_offline_is_sent_to_an_offline_node() -> None:
    bench = Bench(1)
    bench.scheduler.queue(before := job(1, even_if_offline=True), 0.0)
    bench.take_offline(1)
    bench.scheduler.queue(after := job(1, even_if_offline=True), 0.0)
    assert bench.scheduler.next_job(0.0) is before
    assert bench.scheduler.next_job(0.0) is after


def test_an_offline_nodes_callers_who_left_are_forgotten() -> None:
    bench = Bench(1)
    bench.take_offline(1)
    waiting = job(1)
    bench.scheduler.queue(waiting, 0.0)
    assert isinstance(waiting.sink, Sink)
    waiting.sink.cancelled = True
    bench.scheduler.expire(0.0)
    assert (bench.scheduler.waiting(), results(waiting)) == (0, [])


def test_a_retried_request_stays_first_of_its_node_and_the_other_nodes_go_before_it() -> None:
    bench = Bench(1, 2)
    first, second, other = job(1), job(1), job(2)
    for each in (first, second, other):
        bench.scheduler.queue(each, 0.0)
    assert bench.scheduler.next_job(0.0) is first
    bench.scheduler.retry(first)
    assert [bench.scheduler.next_job(0.0) for _ in range(3)] == [other, first, second]
