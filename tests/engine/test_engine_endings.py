"""What ends a run from outside: restarts, the e-stop, a lost line, strays."""

from __future__ import annotations

from typing import Any

import pytest

from servobus.engine.job import JobKind
from servobus.engine.stats import Counter
from servobus.errors import EStopped, LinkDown, NotEnabled, ReplyTimeout
from servobus.protocols.base import Plan, Request
from tests.engine.driven_engine import FENCE, Rig, ask, stop_plan, three_reads
from tests.engine.toy_protocol import ANSWER, PING, READ, read, reply, ticket, write

# Restarts


def test_a_servo_that_has_restarted_ends_what_would_move_it() -> None:
    rig = Rig()
    rig.driver.restarted.add(1)
    rig.doubt(1)
    results = rig.submit(plan=three_reads(), node=1, kind=JobKind.MOTION)
    assert rig.answer() == FENCE
    assert isinstance(results[0], NotEnabled)
    assert "arm: the servo has restarted" in str(results[0])
    assert (rig.restarts, rig.next()) == ([1], b"")


def test_a_servo_that_has_restarted_can_still_be_asked() -> None:
    rig = Rig()
    rig.driver.restarted.add(1)
    rig.doubt(1)
    results = rig.submit(read(1, 5))
    assert [rig.answer(), rig.answer(42)] == [FENCE, ask(5)]
    assert (rig.restarts, results) == ([1], [42])


def test_a_goal_under_way_is_not_repeated_to_a_servo_that_has_restarted() -> None:
    rig = Rig()
    ended: list[tuple[str, Any]] = []
    rig.driver.plan_goals = lambda goals, **_: [_confirmed_turn(rig)]  # type: ignore[method-assign]
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
    results = rig.submit(plan=three_reads(), node=1)
    assert rig.answer(1) == ask(10)
    pending = [rig.engine.runner.estop_pending]
    stopped = rig.estop(stop_plan(2))
    pending.append(rig.engine.runner.estop_pending)
    assert rig.answer() == ask(100)
    pending.append(rig.engine.runner.estop_pending)
    assert rig.answer() == ask(101)
    pending.append(rig.engine.runner.estop_pending)
    assert (stopped, pending) == (["stopped"], [False, True, True, False]), "to its last frame"
    assert [rig.answer(2), rig.answer(3)] == [ask(11), ask(12)]
    assert results == [[1, 2, 3]]


def test_what_moves_is_ended_by_it_and_tells_its_plan() -> None:
    closed: list[bool] = []

    def moving() -> Plan[None]:
        try:
            yield read(1, 10)
            yield read(1, 11)
        finally:
            closed.append(True)

    rig = Rig()
    results = rig.submit(plan=moving(), node=1, kind=JobKind.MOTION)
    assert rig.answer() == ask(10)
    stopped = rig.estop(stop_plan())
    assert rig.answer() == ask(100)
    assert isinstance(results[0], EStopped)
    assert str(results[0]).startswith("arm: the e-stop came first")
    assert (closed, stopped, rig.next()) == ([True], ["stopped"], b"")


def test_a_second_estop_waits_for_the_first_and_what_was_suspended_for_both() -> None:
    rig = Rig()
    results = rig.submit(plan=three_reads(), node=1)
    rig.answer(1)
    first = rig.estop(stop_plan(2))
    assert rig.answer() == ask(100)
    second = rig.estop(stop_plan(1))
    assert rig.answer() == ask(101), "a hold that went on after a limp would switch the torque on"
    assert (first, second) == (["stopped"], [])
    assert rig.answer() == ask(100)
    assert second == ["stopped"]
    assert [rig.answer(2), rig.answer(3)] == [ask(11), ask(12)]
    assert results == [[1, 2, 3]]


def test_an_estop_may_come_while_a_fence_is_out_and_the_fence_goes_on() -> None:
    rig = Rig()
    rig.doubt(2)
    results = rig.submit(read(2, 5))
    fence = rig.transmit()
    assert fence is not None
    assert fence.frame[3:-1] == FENCE
    rig.estop(stop_plan())
    rig.receive(reply(2, PING, 0).frame)
    assert [rig.answer(), rig.answer(42)] == [ask(100), ask(5)]
    assert results == [42]


def test_an_estop_names_the_servo_where_there_is_one() -> None:
    rig = Rig()
    assert str(rig.engine.runner.estopped("elbow")).startswith("arm/elbow:")


# The line


def babble(rig: Rig, seconds: float) -> None:
    """Bytes arrive without a pause for that long, and the engine is asked for its next action after each."""
    end = rig.now + seconds
    while rig.now < end:
        rig.receive(b"\x00")
        rig.engine.next_action(rig.now)


def test_a_line_that_never_falls_silent_fails_a_plan_but_no_estop() -> None:
    rig = Rig()
    babble(rig, 0.3)
    assert rig.line.babbling, "nothing was under way"
    rig.now += 1.0
    results = rig.submit(plan=three_reads(), node=1)
    assert rig.answer() == ask(10)
    babble(rig, 0.3)
    assert isinstance(results[0], ReplyTimeout)
    assert "never falls silent" in str(results[0])
    stopped = rig.estop(stop_plan(2))
    for _ in range(2):
        rig.receive(b"\x00")
        assert rig.answer()[0] == READ
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
    rig.engine.lost(LinkDown("unplugged"))
    assert [len(results) for results in (suspended, waiting, running, second, ended)] == [1, 1, 1, 1, 1]
    assert {type(results[0]) for results in (suspended, waiting, running, second)} == {LinkDown}
    assert "unplugged" in str(running[0])
    assert "may have been applied" not in str(running[0]), "it only reads"
    assert "nothing was sent" in str(waiting[0])
    assert isinstance(ended[0][1], LinkDown)
    assert (rig.engine.idle, rig.next(), rig.scheduler.waiting()) == (True, b"", 0)
    rig.engine.lost(LinkDown("again"))


# Strays


def test_a_stray_makes_its_node_doubtful_and_is_remembered() -> None:
    rig = Rig()
    rig.submit(read(1, 5))
    rig.hear(reply(2, READ, 9).frame, reply(1, READ, 7).frame)
    assert [rig.node(number).health for number in (1, 2, 3)] == ["online", "doubtful", "online"]
    assert list(rig.node(2).outstanding) == [READ | ANSWER]
    assert rig.stats.counts[Counter.STRAYS] == 1


def test_a_stray_of_a_node_nobody_asked_or_configured_is_only_counted() -> None:
    rig = Rig()
    rig.engine.receive(reply(77, READ, 9).frame, rig.now)
    assert (rig.node(77).health, rig.stats.counts[Counter.STRAYS]) == ("online", 1)


def test_a_doubled_reply_of_a_node_of_this_request_makes_it_doubtful() -> None:
    rig = Rig()
    rig.submit(read(77, 5), even_if_offline=True)
    rig.hear(reply(77, READ, 9).frame * 2)
    assert rig.node(77).health == "doubtful"


def test_a_late_reply_teaches_and_stays_outstanding_from_when_it_was_asked_for() -> None:
    rig = Rig()
    rig.submit(read(1, 5), tries=1)
    rig.miss()
    rig.now += 0.05
    rig.engine.receive(reply(1, READ, 9).frame, rig.now)
    assert rig.node(1).reply_allowance_s > 0.05
    assert rig.node(1).outstanding == {READ | ANSWER: 1.0}


@pytest.mark.parametrize(
    ("asked", "applied"),
    [((read(1),), False), ((read(1), read(1, 1)), False), ((write(1, 5),), True), ((write(1, 5), read(1)), True)],
    ids=["read", "plan that reads", "write", "plan that reads back"],
)
@pytest.mark.parametrize("ending", ["no reply", "line lost"])
def test_only_what_asks_for_a_change_may_have_been_applied(asked: tuple[Request[Any], ...], applied: bool, ending: str) -> None:
    def plan() -> Plan[list[Any]]:
        values = []
        for request in asked:
            values.append((yield request))  # noqa: PERF401 - a plan cannot yield inside a comprehension
        return values

    rig = Rig()
    results = rig.submit(asked[0], tries=1) if len(asked) == 1 else rig.submit(plan=plan(), node=1, tries=1)
    for _ in asked[1:]:
        rig.answer()
    if ending == "no reply":
        rig.miss()
    else:
        assert rig.next()
        rig.engine.lost(LinkDown("unplugged"))
    assert ("may have been applied" in str(results[0])) == applied
