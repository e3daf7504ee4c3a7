"""The queue: in order within a node, in turn between nodes, bounded, and nothing waits for ever."""

from __future__ import annotations

import pytest

from servobus.engine.job import Callback, Job
from servobus.engine.queue import RequestQueue, overloaded
from servobus.errors import LinkDown, Overloaded, ReplyTimeout
from servobus.protocols.base import Plan
from tests.engine.toy_protocol import Sink, read, write


def job(node: int, register: int = 0, *, expires: float = 1.0, session: object = None) -> Job:
    return Job(Sink(), expires, request=read(node, register), session=session)


def sink(of: Job) -> Sink:
    assert isinstance(of.sink, Sink)
    return of.sink


def queue_of(*jobs: Job, limit: int = 100) -> RequestQueue:
    queue = RequestQueue(limit)
    for each in jobs:
        queue.put(each)
    return queue


def drain(queue: RequestQueue, now: float = 0.0, session: object = None) -> list[Job]:
    return list(iter(lambda: queue.take(now, session), None))


def test_order_within_a_node_and_turns_between_nodes() -> None:
    a, b, c = ([job(node) for _ in range(count)] for node, count in ((1, 4), (2, 2), (3, 1)))
    queue = queue_of(*a, *b, *c)
    assert drain(queue) == [a[0], b[0], c[0], a[1], b[1], a[2], a[3]]
    assert len(queue) == 0
    assert queue.take(0.0) is None


def test_one_busy_caller_does_not_starve_another() -> None:
    flood = [job(1) for _ in range(50)]
    queue = queue_of(*flood)
    assert queue.take(0.0) is flood[0]
    late = job(2)
    queue.put(late)
    assert drain(queue)[:2] == [flood[1], late]


def test_it_is_full_at_exactly_its_limit() -> None:
    queue = queue_of(*(job(node) for node in range(3)), limit=3)
    with pytest.raises(Overloaded, match="3 requests wait"):
        queue.put(job(9))
    assert len(queue) == 3
    assert queue.take(0.0) is not None
    queue.put(job(9))
    with pytest.raises(Overloaded):
        queue.put(job(9))


def test_what_was_begun_goes_back_before_all_of_its_node_and_is_never_refused() -> None:
    first, second, other, third = job(1), job(1), job(2), job(3)
    queue = queue_of(first, second, other, limit=3)
    assert queue.take(0.0) is first
    queue.put(third)
    queue.put_back(first)
    assert len(queue) == 4
    assert drain(queue) == [other, first, third, second]


def test_what_goes_back_to_an_empty_line_is_served_after_the_others() -> None:
    first, other = job(1), job(2)
    queue = queue_of(first, other)
    assert queue.take(0.0) is first
    queue.put_back(first)
    assert drain(queue) == [other, first]


def test_jobs_nobody_awaits_are_dropped_and_their_plans_closed() -> None:
    closed = []

    def plan() -> Plan[None]:
        try:
            yield read(1)
        finally:
            closed.append(True)

    begun = plan()
    next(begun)
    abandoned, wanted = Job(Sink(), 1.0, plan=begun, node=1), job(1)
    sink(abandoned).cancelled = True
    queue = queue_of(abandoned, wanted)
    assert drain(queue) == [wanted]
    assert (closed, sink(abandoned).results, len(queue)) == ([True], [], 0)


def test_a_job_waits_until_it_expires_and_not_at_it() -> None:
    on_time, late = job(1, expires=1.0), job(2, expires=1.0)
    queue = queue_of(on_time, late)
    assert queue.take(0.999) is on_time
    assert queue.take(1.0) is None
    (error,) = sink(late).results
    assert isinstance(error, ReplyTimeout)
    assert "servobus check" in str(error)
    assert error.raw == read(2).frame


def test_a_job_that_was_sent_already_says_so_when_it_expires() -> None:
    for request, applied in ((read(1), False), (write(1, 5), True)):
        sent = Job(Sink(), 1.0, request=request)
        sent.attempts = 1
        assert queue_of(sent).take(1.0) is None
        assert "no reply" in str(sink(sent).results[0])
        assert ("may have been applied" in str(sink(sent).results[0])) == applied


def test_expire_fails_what_stands_first_and_is_too_old() -> None:
    jobs = [job(1, expires=1.0), job(1, expires=2.0), job(2, expires=1.5)]
    queue = queue_of(*jobs)
    assert queue.next_expiry() == 1.0
    queue.expire(1.0)
    assert [len(sink(each).results) for each in jobs] == [1, 0, 0]
    assert queue.next_expiry() == 1.5
    queue.expire(2.0)
    assert [len(sink(each).results) for each in jobs] == [1, 1, 1]
    assert (len(queue), queue.next_expiry()) == (0, None)


def test_the_next_job_is_taken_after_all_of_one_node_expired() -> None:
    queue = queue_of(job(1, expires=1.0), other := job(2, expires=9.0))
    queue.expire(2.0)
    assert drain(queue, 2.0) == [other]


def test_a_plan_that_never_began_can_expire_too() -> None:
    def plan() -> Plan[None]:
        yield read(1)

    waiting = Job(Sink(), 1.0, plan=plan(), node=1)
    queue_of(waiting).expire(1.0)
    assert isinstance(sink(waiting).results[0], ReplyTimeout)


def test_a_session_is_served_past_whatever_waits_for_its_nodes() -> None:
    session, other = object(), object()
    theirs = [job(1), job(1, session=other), job(2)]
    ours = [job(1, session=session), job(1, session=session), job(3, session=session)]
    queue = queue_of(*theirs, *ours)
    assert drain(queue, session=session) == [ours[0], ours[2], ours[1]]
    assert drain(queue) == [theirs[2], theirs[0], theirs[1]]


def test_remove_takes_out_what_is_unwanted_in_order() -> None:
    jobs = [job(1), job(1), job(1), job(2)]
    queue = queue_of(*jobs)
    assert queue.remove(lambda each: each in (jobs[0], jobs[2], jobs[3])) == [jobs[0], jobs[2], jobs[3]]
    assert len(queue) == 1
    assert queue.remove(lambda each: each in (jobs[3],)) == []
    assert drain(queue) == [jobs[1]]


def test_a_callback_is_called_once() -> None:
    results: list[object] = []
    good, bad = Callback(results.append), Callback(results.append)
    assert not good.done()
    waiting = Job(good, 1.0, request=read(1))
    waiting.succeed(5)
    waiting.succeed(6)
    assert good.done()
    error = LinkDown("gone")
    failed = Job(bad, 1.0, request=read(1))
    failed.fail(error)
    failed.fail(error)
    assert results == [5, error]


def test_overload_says_how_many_wait() -> None:
    assert "7 requests" in str(overloaded(7))
