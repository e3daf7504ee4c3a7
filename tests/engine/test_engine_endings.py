"""What ends a run from outside: restarts, the e-stop, a lost line, strays."""

from __future__ import annotations

from typing import Any

from servobus.errors import EStopped, LinkDown, NotEnabled, ReplyTimeout
from servobus.protocols.base import Plan
from tests.engine.driven_engine import FENCE, Rig, ask, stop_plan, three_reads
from tests.engine.toy_protocol import ANSWER, READ, read, reply, ticket

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
