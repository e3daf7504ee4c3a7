"""The runner: fences before doubt, retries where allowed, e-stop between frames, and an end for everything."""

from __future__ import annotations

from typing import Any

import pytest

from servobus.bus.health import FIRST_DEADLINE, GREATEST_DEADLINE
from servobus.bus.queue import TRIES, Job
from servobus.bus.runner import Runner
from servobus.bus.stats import BusStats
from servobus.bus.turn import Turn, judge
from servobus.errors import DeviceError, EStopped, LinkDown, NotEnabled, ReplyTimeout, ServobusError
from servobus.protocols.base import Plan, Request
from tests.bus.toy import (
    ANSWER,
    PING,
    READ,
    REFUSED,
    Bench,
    Sink,
    ToyCodec,
    group_read,
    read,
    reply,
    shout,
    ticket,
    write,
)


class Rig(Bench):
    """A runner whose line the test speaks for. All nodes are online unless the test says otherwise."""

    def __init__(self, *nodes: int, **keys: Any) -> None:
        super().__init__(*nodes, **keys)
        self.stats = BusStats(0.0)
        self.runner = Runner("arm", self.scheduler, self.health, self.stats)
        self.now = 1.0

    def submit(self, request: Request[Any] | None = None, *, plan: Plan[Any] | None = None, **traits: Any) -> list[Any]:
        """What its caller was told."""
        sink = Sink()
        self.scheduler.submit(Job(sink, 100.0, request=request, plan=plan, **traits), self.now)
        return sink.results

    def estop(self, plan: Plan[Any]) -> list[Any]:
        sink = Sink()
        self.scheduler.drop(self.runner.estopped, motion_only=True)
        self.scheduler.estop.append(Job(sink, 100.0, plan=plan, node=1))
        return sink.results

    def next(self) -> bytes:
        """The payload said next; empty: nothing. What nobody answers is reported as sent."""
        request = self.runner.next_request(self.now)
        if request is None:
            return b""
        if not request.replies:
            self.runner.sent(request)
        return request.frame[3:-1]

    def hear(self, *frames: bytes, latency: float = 0.001) -> Turn:
        """The next request is said, and these frames are all that comes."""
        request = self.runner.next_request(self.now)
        assert request is not None
        turn, codec, strays = Turn(request, sent_at=self.now, sent_by=self.now, deadline=self.now), ToyCodec(), list[Any]()
        codec.receive_data(b"".join(frames))
        believed = judge(codec, turn, strays)
        if strays:
            self.runner.strays(strays, turn, self.now)
        if believed:
            self.runner.answered(turn, latency)
        else:
            self.runner.missed(turn, self.now, latency)
        return turn

    def answer(self, value: int = 0) -> bytes:
        """The next request is said and properly answered; its payload."""
        request = self.runner.next_request(self.now)
        assert request is not None
        payload = request.frame[3:-1]
        told = payload[1] if payload[0] == PING else value
        self.hear(*(reply(node, payload[0], told).frame for node in request.nodes))
        return payload

    def miss(self) -> bytes:
        request = self.runner.next_request(self.now)
        assert request is not None
        self.hear()
        return request.frame[3:-1]

    def doubt(self, node: int, key: Any = READ | ANSWER) -> None:
        self.health.doubt(self.node(node), key, self.now)


def three_reads() -> Plan[list[int]]:
    values = []
    for register in (10, 11, 12):
        values.append((yield read(1, register)))  # noqa: PERF401 - a plan cannot yield inside a comprehension
    return values


def careful() -> Plan[str]:
    try:
        yield read(1, 10)
    except ServobusError as error:
        yield shout(1)
        return type(error).__name__
    return "well"


def stop_plan(frames: int = 1) -> Plan[str]:
    for number in range(frames):
        yield read(1, 100 + number)
    return "stopped"


FENCE = bytes((PING, 0))


def ask(register: int) -> bytes:
    return bytes((READ, register))


# The plain way


def test_a_request_is_said_and_its_caller_told() -> None:
    rig = Rig()
    told = rig.submit(read(1, 5))
    assert rig.runner.idle
    assert rig.answer(42) == ask(5)
    assert (told, rig.runner.idle, rig.next()) == ([42], True, b"")


def test_what_nobody_answers_is_done_when_it_is_sent() -> None:
    rig = Rig()
    told = rig.submit(shout(7))
    assert rig.next() == bytes((3, 7))
    assert told == [None]


def test_a_plan_keeps_the_line_from_its_first_frame_to_its_last() -> None:
    rig = Rig()
    told, other = rig.submit(plan=three_reads(), node=1), rig.submit(read(2, 99))
    assert [rig.answer(value) for value in (1, 2, 3, 4)] == [ask(10), ask(11), ask(12), ask(99)]
    assert (told, other) == ([[1, 2, 3]], [4])


def test_a_plan_that_fails_at_once_costs_nothing_and_the_next_goes_on() -> None:
    def refuses() -> Plan[None]:
        yield from ()
        raise DeviceError("no such thing")

    rig = Rig()
    told, other = rig.submit(plan=refuses(), node=1), rig.submit(read(2, 99))
    assert rig.answer(4) == ask(99)
    assert str(told[0]) == "arm: no such thing"
    assert other == [4]


def test_how_soon_a_node_answers_is_learned() -> None:
    rig = Rig()
    for _ in range(50):
        rig.submit(read(1))
        rig.submit(read(2))
        rig.hear(reply(1, READ, 0).frame, latency=0.030)
        rig.hear(reply(2, READ, 0).frame, latency=0.001)
    assert rig.node(1).deadline > 0.030 > rig.node(2).deadline


# Fences


def test_a_fence_goes_before_a_question_to_a_doubtful_node() -> None:
    rig = Rig()
    rig.doubt(1)
    told = rig.submit(read(1, 5))
    assert [rig.answer(), rig.answer(42)] == [FENCE, ask(5)]
    assert (told, rig.node(1).condition, rig.stats.counts["fences"]) == ([42], "online", 1)


def test_the_fence_looks_like_nothing_that_may_still_come() -> None:
    rig = Rig()
    rig.doubt(1, (PING | ANSWER, 0))
    rig.submit(read(1, 5))
    assert rig.answer() == bytes((PING, 1))


def test_another_node_needs_no_fence_nor_what_nobody_answers() -> None:
    rig = Rig()
    rig.doubt(1)
    rig.submit(read(2, 5))
    assert rig.answer() == ask(5)
    rig = Rig()
    rig.doubt(1)
    rig.submit(shout(6))
    assert rig.next() == bytes((3, 6))


def test_each_doubtful_node_of_a_group_is_fenced() -> None:
    rig = Rig()
    rig.doubt(1)
    rig.doubt(3)
    told = rig.submit(group_read(1, 2, 3))
    assert [rig.answer(), rig.answer(), rig.answer(9)] == [FENCE, FENCE, ask(0)]
    assert told == [{1: 9, 2: 9, 3: 9}]


def test_a_probe_is_its_own_fence() -> None:
    rig = Rig(online=False)
    assert rig.answer() == FENCE
    assert (rig.node(1).condition, rig.stats.counts["fences"]) == ("online", 1)


def test_an_unanswered_fence_costs_a_try_and_is_never_repeated_as_it_was() -> None:
    rig = Rig()
    rig.doubt(1)
    told = rig.submit(read(1, 5))
    assert [rig.miss(), rig.miss()] == [FENCE, bytes((PING, 1))]
    assert (told, rig.node(1).misses) == ([], 2)
    assert [rig.answer(), rig.answer(42)] == [bytes((PING, 2)), ask(5)]
    assert told == [42]


def test_a_node_that_answers_no_fence_goes_offline_and_its_caller_is_told() -> None:
    rig = Rig()
    rig.doubt(1)
    told = rig.submit(read(1, 5))
    for _ in range(3):
        rig.miss()
    (error,) = told
    assert isinstance(error, ReplyTimeout)
    assert (rig.node(1).condition, rig.runner.idle) == ("offline", True)


def test_a_plan_is_told_of_the_fence_that_failed_and_goes_its_own_way() -> None:
    rig = Rig()
    rig.take_offline(1)
    told = rig.submit(plan=careful(), node=1, urgent=True)
    rig.miss()
    assert rig.next() == bytes((3, 1))
    assert told == ["ReplyTimeout"]


# Retries


def test_what_may_be_repeated_is_said_up_to_its_tries_each_behind_a_fence() -> None:
    rig = Rig()
    told = rig.submit(read(1, 5))
    for attempt in range(TRIES):
        if attempt:
            assert rig.answer()[0] == PING
        assert rig.miss() == ask(5)
    (error,) = told
    assert isinstance(error, ReplyTimeout)
    assert f"no answer after {TRIES} tries" in str(error)
    assert (error.bus, error.raw) == ("arm", read(1, 5).frame)
    assert rig.stats.counts["retries"] == TRIES - 1


def test_a_retry_waits_until_the_other_nodes_had_their_turn() -> None:
    rig = Rig()
    told, second, other = rig.submit(read(1, 5)), rig.submit(read(1, 6)), rig.submit(read(2, 7))
    assert [rig.miss(), rig.answer()] == [ask(5), FENCE], "after a request a probe, for one is due now"
    assert [rig.answer(7), rig.answer(8), rig.answer(9)] == [ask(7), ask(5), ask(6)]
    assert (told, second, other) == ([8], [9], [7])


def test_a_plan_repeats_its_frame_and_keeps_the_line() -> None:
    rig = Rig()
    rig.submit(plan=three_reads(), node=1)
    rig.submit(read(2, 99))
    assert [rig.answer(), rig.miss(), rig.answer(), rig.answer(), rig.answer()] == [ask(10), ask(11), FENCE, ask(11), ask(12)]


@pytest.mark.parametrize(("request_", "traits"), [(read(1, 5, idempotent=False), {}), (read(1, 5), {"tries": 1})])
def test_what_may_not_be_repeated_is_said_once(request_: Request[Any], traits: dict[str, Any]) -> None:
    rig = Rig()
    told = rig.submit(request_, **traits)
    assert rig.miss() == ask(5)
    assert "after 1 try:" in str(told[0])
    assert rig.runner.idle
    assert rig.stats.counts["retries"] == 0


def test_an_offline_node_is_asked_once() -> None:
    rig = Rig()
    rig.take_offline(1)
    told = rig.submit(read(1, 5), urgent=True)
    assert rig.miss() == FENCE
    assert isinstance(told[0], ReplyTimeout)
    assert rig.next() == b""


def test_a_request_that_was_heard_back_is_asked_differently() -> None:
    rig = Rig()
    told = rig.submit(write(1, 5))
    assert rig.hear(write(1, 5).frame).echoes == 1
    assert rig.answer()[0] == PING
    assert rig.answer(5) == ask(5), "what was to be written is read"
    assert told == [5]


def test_a_rejected_window_is_a_miss_of_all_its_nodes() -> None:
    rig = Rig()
    told = rig.submit(read(1, 5))
    assert rig.hear(reply(1, READ, 42).frame, b"\x00").complete()
    assert (told, rig.node(1).condition, rig.node(1).misses) == ([], "doubtful", 1)
    assert [rig.answer(), rig.answer(7)] == [FENCE, ask(5)]
    assert told == [7]


# Groups


def test_a_group_read_believes_who_answered_and_doubts_who_did_not() -> None:
    rig = Rig()
    before = rig.node(1).deadline
    told = rig.submit(group_read(1, 2, 3))
    rig.hear(reply(1, READ, 10).frame, reply(3, READ, 30).frame, latency=GREATEST_DEADLINE)
    assert told == [{1: 10, 3: 30}]
    assert [rig.node(number).condition for number in (1, 2, 3)] == ["online", "doubtful", "online"]
    assert rig.node(1).deadline == before == FIRST_DEADLINE, "those who answered do not pay for the one who did not"


def test_a_group_read_nobody_answered_is_a_miss() -> None:
    rig = Rig()
    told = rig.submit(group_read(1, 2), tries=1)
    rig.hear()
    assert isinstance(told[0], ReplyTimeout)


def test_a_group_read_behind_which_stands_junk_is_not_believed() -> None:
    rig = Rig()
    told = rig.submit(group_read(1, 2), tries=1)
    rig.hear(reply(1, READ, 10).frame, reply(2, READ, 20).frame, b"\x00")
    assert isinstance(told[0], ReplyTimeout)
    assert [rig.node(number).condition for number in (1, 2)] == ["doubtful", "doubtful"]


def test_a_group_that_must_be_whole_is_asked_again() -> None:
    rig = Rig()
    told = rig.submit(group_read(1, 2, partial=False))
    rig.hear(reply(1, READ, 10).frame)
    assert [rig.answer(), rig.answer(5)] == [FENCE, ask(0)]
    assert told == [{1: 5, 2: 5}]


@pytest.mark.parametrize("whole", [True, False])
def test_a_group_read_that_cannot_be_understood_ends_in_its_error(whole: bool) -> None:
    rig = Rig()
    told = rig.submit(group_read(1, 2))
    frames = [reply(1, READ, REFUSED).frame, reply(2, READ, 5).frame]
    rig.hear(*frames[: 2 if whole else 1])
    assert isinstance(told[0], DeviceError)
    assert rig.runner.idle


# Mistakes


def test_an_answer_that_says_no_ends_its_request_with_that() -> None:
    rig = Rig()
    told = rig.submit(read(1, 5))
    rig.answer(REFUSED)
    assert str(told[0]) == "arm: it says no"
    assert rig.node(1).condition == "online", "it has answered"


def test_a_mistake_in_a_driver_ends_its_job_and_never_the_bus() -> None:
    def broken() -> Plan[None]:
        yield read(1, 1)
        raise KeyError("a mistake")

    rig = Rig()
    odd = read(2, 2)
    odd.parse = lambda replies: replies[7]  # type: ignore[method-assign]
    told, parsed, other = rig.submit(plan=broken(), node=1), rig.submit(odd), rig.submit(read(3, 3))
    assert [rig.answer(), rig.answer(), rig.answer(9)] == [ask(1), ask(2), ask(3)]
    assert [type(each[0]) for each in (told, parsed)] == [KeyError, IndexError]
    assert other == [9]


# Restarts


def test_a_servo_that_has_restarted_ends_what_would_move_it() -> None:
    rig = Rig()
    rig.driver.restarted.add(1)
    rig.doubt(1)
    told = rig.submit(plan=three_reads(), node=1, motion=True)
    assert rig.answer() == FENCE
    assert isinstance(told[0], NotEnabled)
    assert "arm: the servo has restarted" in str(told[0])
    assert (rig.restarts, rig.next()) == ([1], b"")


def test_a_servo_that_has_restarted_can_still_be_asked() -> None:
    rig = Rig()
    rig.driver.restarted.add(1)
    rig.doubt(1)
    told = rig.submit(read(1, 5))
    assert [rig.answer(), rig.answer(42)] == [FENCE, ask(5)]
    assert (rig.restarts, told) == ([1], [42])


def test_a_goal_under_way_is_not_repeated_to_a_servo_that_has_restarted() -> None:
    rig = Rig()
    ended: list[tuple[str, Any]] = []
    rig.driver.plan = lambda goals, **_: [_confirmed_turn(rig)]  # type: ignore[method-assign]
    rig.coalescer.put(ticket(1, ended, expires=9.0))
    assert rig.miss() == ask(50)
    rig.driver.restarted.add(1)
    assert rig.answer() == FENCE
    assert [(servo, type(result)) for servo, result in ended] == [("s1", NotEnabled)]
    assert rig.next() == b""


def _confirmed_turn(rig: Rig) -> Any:
    def plan() -> Plan[Any]:
        value = yield read(1, 50)
        return {"s1": value}

    return type("Turn", (), {"servos": ("s1",), "plan": plan(), "frames": 1})()


# E-stop


def test_an_estop_comes_between_the_frames_of_a_plan_which_goes_on_afterwards() -> None:
    rig = Rig()
    told = rig.submit(plan=three_reads(), node=1)
    assert rig.answer(1) == ask(10)
    urgent = [rig.runner.urgent]
    stopped = rig.estop(stop_plan(2))
    urgent.append(rig.runner.urgent)
    assert rig.answer() == ask(100)
    urgent.append(rig.runner.urgent)
    assert rig.answer() == ask(101)
    urgent.append(rig.runner.urgent)
    assert (stopped, urgent) == (["stopped"], [False, True, True, False]), "to its last frame"
    assert [rig.answer(2), rig.answer(3)] == [ask(11), ask(12)]
    assert told == [[1, 2, 3]]


def test_what_moves_is_ended_by_it_and_tells_its_plan() -> None:
    closed: list[bool] = []

    def moving() -> Plan[None]:
        try:
            yield read(1, 10)
            yield read(1, 11)
        finally:
            closed.append(True)

    rig = Rig()
    told = rig.submit(plan=moving(), node=1, motion=True)
    assert rig.answer() == ask(10)
    stopped = rig.estop(stop_plan())
    assert rig.answer() == ask(100)
    assert isinstance(told[0], EStopped)
    assert str(told[0]).startswith("arm: the e-stop came first")
    assert (closed, stopped, rig.next()) == ([True], ["stopped"], b"")


def test_a_second_estop_waits_for_the_first_and_what_was_suspended_for_both() -> None:
    rig = Rig()
    told = rig.submit(plan=three_reads(), node=1)
    rig.answer(1)
    first = rig.estop(stop_plan(2))
    assert rig.answer() == ask(100)
    second = rig.estop(stop_plan(1))
    assert rig.answer() == ask(101), "a hold that went on after a limp would switch the torque on"
    assert (first, second) == (["stopped"], [])
    assert rig.answer() == ask(100)
    assert second == ["stopped"]
    assert [rig.answer(2), rig.answer(3)] == [ask(11), ask(12)]
    assert told == [[1, 2, 3]]


def test_an_estop_may_come_while_a_fence_is_out_and_the_fence_goes_on() -> None:
    rig = Rig()
    rig.doubt(2)
    told = rig.submit(read(2, 5))
    assert rig.runner.next_request(rig.now) is not None
    rig.estop(stop_plan())
    assert [rig.answer(), rig.answer(), rig.answer(42)] == [ask(100), FENCE, ask(5)]
    assert told == [42]


def test_an_estop_names_the_servo_where_there_is_one() -> None:
    rig = Rig()
    assert str(rig.runner.estopped("elbow")).startswith("arm/elbow:")


# The line


def test_a_line_that_never_falls_quiet_ends_what_is_under_way_but_no_estop() -> None:
    rig = Rig()
    rig.runner.babbled()
    told = rig.submit(plan=three_reads(), node=1)
    rig.answer()
    rig.runner.babbled()
    assert isinstance(told[0], ReplyTimeout)
    assert "never falls quiet" in str(told[0])
    stopped = rig.estop(stop_plan(2))
    rig.answer()
    rig.runner.babbled()
    rig.answer()
    assert stopped == ["stopped"]


def test_a_lost_line_ends_everything() -> None:
    rig = Rig()
    ended: list[tuple[str, Any]] = []
    suspended = rig.submit(plan=three_reads(), node=1)
    rig.answer()
    waiting = rig.submit(read(2, 5))
    running, second = rig.estop(stop_plan(2)), rig.estop(stop_plan())
    rig.answer()
    rig.coalescer.put(ticket(1, ended))
    rig.runner.lost("unplugged")
    assert [len(told) for told in (suspended, waiting, running, second, ended)] == [1, 1, 1, 1, 1]
    assert {type(told[0]) for told in (suspended, waiting, running, second)} == {LinkDown}
    assert "unplugged" in str(running[0])
    assert "may have been applied" in str(running[0])
    assert "nothing was sent" in str(waiting[0])
    assert isinstance(ended[0][1], LinkDown)
    assert (rig.runner.idle, rig.next(), rig.scheduler.waiting()) == (True, b"", 0)
    rig.runner.lost("again")


# Strays


def test_a_stray_makes_its_node_doubtful_and_is_remembered() -> None:
    rig = Rig()
    rig.submit(read(1, 5))
    rig.hear(reply(2, READ, 9).frame, reply(1, READ, 7).frame)
    assert [rig.node(number).condition for number in (1, 2, 3)] == ["online", "doubtful", "online"]
    assert list(rig.node(2).outstanding) == [READ | ANSWER]
    assert rig.stats.counts["strays"] == 1


def test_a_stray_of_a_node_nobody_asked_or_configured_is_only_counted() -> None:
    rig = Rig()
    rig.runner.strays([reply(77, READ, 9)], None, rig.now)
    assert (rig.node(77).condition, rig.stats.counts["strays"]) == ("online", 1)


def test_a_doubled_answer_of_a_node_that_is_looked_for_makes_it_doubtful() -> None:
    rig = Rig()
    rig.submit(read(77, 5), urgent=True)
    rig.hear(reply(77, READ, 9).frame * 2)
    assert rig.node(77).condition == "doubtful"


def test_a_late_reply_teaches_and_stays_outstanding_from_when_it_was_asked_for() -> None:
    rig = Rig()
    rig.submit(read(1, 5), tries=1)
    rig.miss()
    rig.now += 0.05
    rig.runner.strays([reply(1, READ, 9)], None, rig.now)
    assert rig.node(1).deadline > 0.05
    assert rig.node(1).outstanding == {READ | ANSWER: 1.0}
