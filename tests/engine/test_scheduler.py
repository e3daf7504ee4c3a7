"""The scheduler: who goes next, that nobody starves, and that whatever was accepted ends exactly once."""

from __future__ import annotations

import random
from collections import Counter

import pytest

from servobus.engine.health import MAX_BACKOFF
from servobus.engine.job import Job, JobKind
from servobus.engine.polls import PollTimer
from servobus.engine.scheduler import POLL_PATIENCE, PROBE_PAUSE
from servobus.errors import DeviceError, EStopped, Overloaded, ReplyTimeout
from servobus.protocols.base import run_plan
from tests.engine.scheduled_jobs import Ended, Flood, disabled, estopped, finish, job, kind, results, split_bench, stop_job
from tests.engine.toy_protocol import ANSWER, READ, Bench, poll, ticket

# The order of the classes


def test_the_classes_go_in_their_order() -> None:
    bench, ended = Bench(1, 2, 3), Ended()
    bench.nodes.missed(bench.node(3), READ, 0.0, 0.0)
    bench.scheduler.set_polls([poll("feedback", 50, 1)], 0.0)
    bench.scheduler.queue(job(2), 0.0)
    bench.coalescer.put(ticket(1, ended))
    bench.scheduler.put_stop(stop_job())
    assert [kind(bench.scheduler.next_job(0.0)) for _ in range(5)] == ["estop", "goal", "request", "poll", "probe"]


@pytest.mark.parametrize(
    ("classes", "pattern"),
    [
        (("goal", "request", "poll", "probe"), "goal request goal poll goal request goal probe"),
        (("goal", "request", "poll"), "goal request goal poll"),
        (("goal", "poll", "probe"), "goal poll goal probe"),
        (("goal", "request"), "goal request"),
        (("goal", "probe"), "goal probe"),
        (("request", "poll", "probe"), "request poll request probe"),
        (("request", "poll"), "request poll"),
        (("poll", "probe"), "poll probe"),
        (("goal",), "goal"),
        (("request",), "request"),
    ],
)
def test_a_flood_of_one_class_leaves_every_lower_one_its_share(classes: tuple[str, ...], pattern: str) -> None:
    expected = pattern.split()
    assert Flood(*classes).kinds(5 * len(expected)) == 5 * expected


def test_what_comes_late_into_a_flood_of_goals_goes_next() -> None:
    flood = Flood("goal")
    assert set(flood.kinds(10)) == {"goal"}
    flood.classes = ("goal", "request")
    assert flood.kinds(4) == ["request", "goal", "request", "goal"]


def test_after_a_pause_nobody_is_owed_a_turn() -> None:
    flood = Flood("goal")
    flood.kinds(2)
    flood.classes = ()
    assert flood.kinds(1) == ["-"]
    flood.classes = ("goal", "request")
    assert flood.kinds(2) == ["goal", "request"]


def test_an_estop_is_never_owed_to_anybody() -> None:
    flood = Flood("goal", "request")
    for _ in range(5):
        flood.bench.scheduler.put_stop(stop_job())
    assert flood.kinds(7) == ["estop"] * 5 + ["goal", "request"]


# Polls


def test_polls_stand_on_a_fixed_grid_however_late_they_are() -> None:
    timer = PollTimer(poll("feedback", 10, 1), due=1.0)
    timer.advance(1.0)
    assert timer.due == pytest.approx(1.1)
    assert timer.missed == 0
    timer.advance(1.15)
    assert timer.due == pytest.approx(1.2), "late, and the next is on the grid"
    assert timer.missed == 0
    timer.advance(1.75)
    assert timer.due == pytest.approx(1.8), "1.3 to 1.7 passed without a poll"
    assert timer.missed == 5


def test_a_grid_point_that_is_now_belongs_to_this_poll() -> None:
    timer = PollTimer(poll("feedback", 4, 1), due=1.0)
    timer.advance(1.25)
    assert (timer.due, timer.missed) == (1.5, 1)


def test_polls_of_one_rate_are_spread_over_their_period() -> None:
    bench = Bench(1, 2)
    bench.scheduler.set_polls([poll("a", 10, 1), poll("b", 10, 2)], 5.0)
    assert bench.scheduler.wake() == 5.0
    assert kind(bench.scheduler.next_job(5.0)) == "poll"
    assert bench.scheduler.next_job(5.049) is None
    assert bench.scheduler.wake() == pytest.approx(5.05)
    second = bench.scheduler.next_job(5.051)
    assert second is not None
    assert second.request is not None
    assert second.request.nodes == (2,)
    assert (second.tries, second.expires) == (1, 5.051 + POLL_PATIENCE)
    second.succeed({"s2": {}})
    assert bench.updates == [{"s2": {}}]


def test_missed_polls_are_counted_and_the_count_survives_new_polls() -> None:
    bench = Bench(1)
    bench.scheduler.set_polls([poll("a", 10, 1)], 0.0)
    assert kind(bench.scheduler.next_job(0.55)) == "poll"
    assert bench.scheduler.polls.missed == 5
    bench.scheduler.set_polls([poll("a", 10, 1)], 1.0)
    assert bench.scheduler.polls.missed == 5
    bench.scheduler.set_polls([], 1.0)
    assert (bench.scheduler.polls.missed, bench.scheduler.wake()) == (5, None)


def test_a_poll_of_nobody_who_can_be_reached_costs_no_turn() -> None:
    bench = Bench(1, 2)
    bench.take_offline(1)
    bench.scheduler.set_polls([poll("a", 10, 1), poll("b", 10, 1, 2)], 0.0)
    taken = bench.scheduler.next_job(0.05)
    assert taken is not None
    assert taken.request is not None
    assert taken.request.nodes == (2,)


# Probes


def test_a_doubtful_node_is_probed_and_believed_again() -> None:
    bench = Bench(1, online=False)
    taken = bench.scheduler.next_job(0.0)
    assert taken is not None
    assert (taken.kind, taken.node) == (JobKind.PROBE, 1)
    assert taken.plan is not None
    assert run_plan(taken.plan, lambda _: None) is True
    taken.succeed(True)
    assert bench.node(1).health == "online"
    assert (bench.restarts, bench.scheduler.next_job(0.0)) == ([], None)


def test_a_probe_finds_that_a_servo_has_restarted() -> None:
    bench = Bench(1, online=False)
    bench.driver.restarted.add(1)
    finish(bench.scheduler.next_job(0.0))
    assert bench.restarts == [1]


def test_a_probe_that_is_refused_is_not_repeated_at_once() -> None:
    bench = Bench(1, online=False)
    taken = bench.scheduler.next_job(5.0)
    assert taken is not None
    taken.fail(DeviceError("not now"))
    assert bench.node(1).next_probe == 5.0 + PROBE_PAUSE
    assert bench.scheduler.next_job(5.0) is None
    assert kind(bench.scheduler.next_job(5.0 + PROBE_PAUSE)) == "probe"


def test_it_is_woken_for_the_next_probe() -> None:
    bench = Bench(1)
    bench.take_offline(1, now=2.0)
    due = bench.node(1).next_probe
    assert 2.0 < due < 2.0 + MAX_BACKOFF
    assert bench.scheduler.next_job(2.0) is None
    assert bench.scheduler.wake() == due
    assert kind(bench.scheduler.next_job(due)) == "probe"


# Sessions and the e-stop


def test_in_an_exclusive_session_only_its_requests_and_the_estop_go() -> None:
    flood = Flood("goal", "request", "poll", "probe")
    flood.kinds(3)
    scheduler = flood.bench.scheduler
    session = scheduler.open_session()
    ours, stop = job(2, session=session), stop_job()
    scheduler.queue(ours, flood.now)
    scheduler.put_stop(stop)
    assert [flood.turn() for _ in range(3)] == [stop, ours, None]
    assert scheduler.wake() == pytest.approx(1.002), "the first request's end, no probe and no poll"
    scheduler.close_session()
    assert set(flood.kinds(8)) == {"goal", "request", "poll", "probe"}


def test_an_estop_drops_what_moves_wherever_it_waits() -> None:
    ended: Ended = []
    bench, _ = split_bench(ended)
    bench.coalescer.put(ticket(1, ended))
    moving, reading = job(1, kind=JobKind.MOTION), job(1)
    parked_moving, parked_reading = job(3, kind=JobKind.MOTION), job(3)
    for each in (moving, reading):
        bench.scheduler.queue(each, 0.0)
    bench.take_offline(3)
    for each in (parked_moving, parked_reading):
        bench.scheduler.queue(each, 0.0)
    bench.scheduler.drop(estopped, motion_only=True)
    assert sorted(servo for servo, _ in ended) == ["s1", "s2", "s3"]
    assert {type(result) for _, result in ended} == {EStopped}
    assert [type(each) for job_ in (moving, parked_moving) for each in results(job_)] == [EStopped, EStopped]
    bench.nodes.fenced(bench.node(3))
    assert {bench.scheduler.next_job(0.0), bench.scheduler.next_job(0.0)} == {reading, parked_reading}
    assert bench.scheduler.next_job(0.0) is None


def test_a_lost_line_ends_everything() -> None:
    ended: Ended = []
    bench, _ = split_bench(ended)
    jobs = [job(1), job(2, kind=JobKind.MOTION), job(3)]
    bench.take_offline(3)
    for each in jobs:
        bench.scheduler.queue(each, 0.0)
    bench.scheduler.put_stop(stop := stop_job())
    bench.scheduler.drop(estopped, motion_only=False)
    assert [len(results(each)) for each in (*jobs, stop)] == [1, 1, 1, 1]
    assert len(ended) == 2, "the first frame was taken before"
    assert (bench.scheduler.waiting(), bench.scheduler.next_job(0.0)) == (0, None)


# Everything at once


class RandomCalls:
    """A scheduler, and random things that happen to it."""

    def __init__(self, seed: int) -> None:
        self.rng, self.now, self.limit, self.nodes = random.Random(seed), 0.0, 8, (1, 2, 3, 4)
        self.bench, self.jobs = Bench(*self.nodes, limit=self.limit, goals_per_frame=2), list[Job]()
        self.accepted, self.ended = Counter[str](), Ended()
        self.bench.scheduler.set_polls([poll("feedback", 200, *self.nodes)], self.now)

    def step(self) -> None:
        calls = (self.submit, self.put, self.turn, self.node, self.drop)
        self.rng.choices(calls, (30, 30, 40, 5, 2))[0]()
        self.now += self.rng.choice((0.0, 0.001, 0.005))

    def submit(self) -> None:
        new = job(
            self.rng.choice(self.nodes),
            expires=self.now + self.rng.uniform(0.01, 0.1),
            kind=JobKind.MOTION if self.rng.random() < 0.2 else JobKind.ORDINARY,
        )
        try:
            self.bench.scheduler.queue(new, self.now)
        except Overloaded:
            return
        self.jobs.append(new)

    def put(self) -> None:
        number = self.rng.choice(self.nodes)
        self.accepted[f"s{number}"] += 1
        expires, batch = self.now + self.rng.uniform(0.001, 0.05), self.rng.choice((None, None, 1, 2))
        self.bench.coalescer.put(ticket(number, self.ended, expires=expires, batch=batch))

    def turn(self) -> None:
        taken = self.bench.scheduler.next_job(self.now)
        if taken is None:
            self.bench.scheduler.expire(self.now)
        elif self.rng.random() < 0.1:
            taken.fail(ReplyTimeout("no answer"))
        elif taken.plan is not None:
            finish(taken)
        elif self.rng.random() < 0.1:
            self.bench.scheduler.retry(taken)
        else:
            taken.succeed({})

    def node(self) -> None:
        changed = self.bench.node(self.rng.choice(self.nodes))
        if self.rng.random() < 0.5:
            self.bench.nodes.missed(changed, READ | ANSWER, self.now, self.now)
        else:
            self.bench.nodes.fenced(changed)

    def drop(self) -> None:
        if self.rng.random() < 0.05:
            self.bench.scheduler.drop(estopped, motion_only=self.rng.random() < 0.8)
        else:
            self.bench.scheduler.drop_goals(disabled, {f"s{self.rng.choice(self.nodes)}"})


@pytest.mark.parametrize("seed", range(20))
def test_whatever_happens_each_job_and_each_goal_ends_exactly_once(seed: int) -> None:
    calls = RandomCalls(seed)
    scheduler, coalescer = calls.bench.scheduler, calls.bench.coalescer
    for _ in range(1000):
        calls.step()
        assert 0 <= len(scheduler.requests) <= 3 * calls.limit
        assert 0 <= len(coalescer) <= len(calls.nodes)
    scheduler.drop(estopped, motion_only=False)
    assert scheduler.waiting() == 0
    assert Counter(servo for servo, _ in calls.ended) == calls.accepted
    assert [len(results(each)) for each in calls.jobs] == [1] * len(calls.jobs)
    assert len(calls.jobs) > 100
