"""Speed by the host: the ramp of setpoints, its speed, and everything that ends it."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest

from servobus.engine.coalescer import Ticket
from servobus.engine.ramp import SetpointRamps
from servobus.errors import ReplyTimeout
from servobus.values import Goal, Outcome, ServoGoal

HZ = 10.0


class Bench:
    def __init__(self) -> None:
        self.cuts: list[tuple[str, Exception]] = []
        self.setpoint: float | None = None
        """As the servo's record keeps it."""
        self.ramps = SetpointRamps(HZ, lambda servo, error: self.cuts.append((servo, error)), self._sent)
        self.results: list[Any] = []

    def ticket(self, target: float, start: float | None = 0.0, *, now: float = 0.0) -> Ticket:
        return Ticket(ServoGoal("a", Goal("position", target), start), 7, now + 0.2, self.results.append)

    def begin(self, target: float, start: float | None = 0.0, *, speed: float = 100.0, now: float = 0.0) -> Ticket:
        ticket = self.ticket(target, start, now=now)
        self.ramps.begin(ticket, speed, start if self.setpoint is None else self.setpoint, now)
        return ticket

    def _sent(self, servo: str, setpoint: float) -> None:
        self.setpoint = setpoint

    def run(self, ticket: Ticket, until: float = 10.0) -> list[tuple[float, float]]:
        """(time, setpoint) of the whole ramp, each delivered at once."""
        row = [(0.0, ticket.goal.goal.value)]
        ticket.done(Outcome.ACKED)
        while (due := self.ramps.next_due()) is not None and due < until:
            for following in self.ramps.due(due):
                row.append((round(due, 6), round(following.goal.goal.value, 6)))
                following.done(Outcome.ACKED)
        return row


def test_a_goal_becomes_a_ramp_of_setpoints_on_the_cycle() -> None:
    bench = Bench()
    assert bench.run(bench.begin(35)) == [(0.0, 10), (0.1, 20), (0.2, 30), (0.3, 35)]
    assert bench.results == [Outcome.ACKED], "the caller's ticket is the first setpoint's"
    assert bench.ramps.next_due() is None


@pytest.mark.parametrize("target", [-25.0, -10.0, 0.0, 10.0, 10.000001, 25.0])
def test_no_step_is_longer_than_one_cycle_at_that_speed(target: float) -> None:
    bench = Bench()
    setpoints = [0.0, *(setpoint for _, setpoint in bench.run(bench.begin(target)))]
    assert setpoints[-1] == target
    assert max(abs(one - other) for one, other in pairwise(setpoints)) <= 100 / HZ


def test_the_first_setpoint_may_be_the_last() -> None:
    bench = Bench()
    ticket = bench.begin(10)
    assert ticket.goal.goal.value == 10
    assert "a" in bench.ramps.active
    ticket.done(Outcome.ACKED)
    assert bench.ramps.next_due() is None
    assert "a" not in bench.ramps.active


def test_a_late_cycle_is_not_caught_up_with() -> None:
    bench = Bench()
    bench.begin(100).done(Outcome.ACKED)
    (ticket,) = bench.ramps.due(5.0)
    assert ticket.goal.goal.value == 20
    assert ticket.expires == 5.2
    assert bench.ramps.due(5.0) == []
    ticket.done(Outcome.ACKED)
    assert bench.ramps.next_due() == pytest.approx(5.1)


def test_no_setpoint_is_made_while_one_is_under_way_and_the_grid_is_kept() -> None:
    """A servo that does not answer is not run away from, and none of its setpoints is superseded by the next."""
    bench = Bench()
    bench.begin(100).done(Outcome.ACKED)
    (ticket,) = bench.ramps.due(0.1)
    assert (bench.ramps.due(0.2), bench.ramps.due(0.3), bench.ramps.next_due()) == ([], [], None)
    ticket.done(Outcome.ACKED)
    (late,) = bench.ramps.due(0.32)
    assert late.goal.goal.value == 30, "one step from the last, however long that took"
    late.done(Outcome.ACKED)
    assert bench.ramps.next_due() == pytest.approx(0.42)


def test_each_setpoint_may_be_one_step_ahead_of_where_the_servo_is_read() -> None:
    bench = Bench()
    first = bench.begin(-35)
    assert first.goal.lead == 10
    first.done(Outcome.ACKED)
    (second,) = bench.ramps.due(0.1)
    assert (second.goal.goal.value, second.goal.lead) == (-20, 10)


def test_the_ramp_goes_on_from_where_the_driver_sent_less() -> None:
    """The servo lags or is blocked: the ramp waits for it, and ends only when the goal itself was sent."""
    bench = Bench()
    bench.begin(30).done(Outcome.ACKED)
    setpoints = []
    for number in range(1, 9):
        due = bench.ramps.next_due()
        if due is None:
            break
        (ticket,) = bench.ramps.due(due)
        setpoints.append(ticket.goal.goal.value)
        ticket.goal.applied = 10.5 if number < 4 else None
        ticket.done(Outcome.ACKED)
        assert bench.setpoint == (10.5 if number < 4 else setpoints[-1])
    assert setpoints == [20, 20.5, 20.5, 20.5, 30]
    assert "a" not in bench.ramps.active


def test_a_first_setpoint_that_was_sent_nearer_is_not_the_last() -> None:
    bench = Bench()
    ticket = bench.begin(10)
    ticket.goal.applied = 4.0
    ticket.done(Outcome.ACKED)
    (following,) = bench.ramps.due(0.1)
    assert following.goal.goal.value == 10


def test_a_ramp_turns_round_where_the_servo_is_read_beyond_its_goal() -> None:
    """It begins where the servo was sent, and that may not be where it is."""
    bench = Bench()
    bench.setpoint = 50.0
    ticket = bench.begin(20)
    assert ticket.goal.goal.value == 40
    ticket.goal.applied = 0.0
    ticket.done(Outcome.ACKED)
    (following,) = bench.ramps.due(0.1)
    assert following.goal.goal.value == 10


def test_nothing_follows_before_the_first_was_delivered() -> None:
    bench = Bench()
    ticket = bench.begin(50)
    assert bench.ramps.due(9.0) == []
    ticket.done(ReplyTimeout("lost"))
    assert bench.ramps.due(9.0) == []
    assert isinstance(bench.results[0], ReplyTimeout)
    assert bench.cuts == [], "the caller has the error"


def test_a_setpoint_that_fails_ends_the_ramp_and_is_reported() -> None:
    bench = Bench()
    bench.begin(50).done(Outcome.ACKED)
    (ticket,) = bench.ramps.due(0.1)
    error = ReplyTimeout("lost")
    ticket.done(error)
    assert bench.cuts == [("a", error)]
    assert bench.ramps.next_due() is None
    ticket.done(error)
    assert len(bench.cuts) == 1


def test_a_setpoint_that_was_superseded_by_no_goal_of_a_caller_ends_the_ramp_and_is_reported() -> None:
    bench = Bench()
    bench.begin(50).done(Outcome.ACKED)
    (ticket,) = bench.ramps.due(0.1)
    ticket.done(Outcome.SUPERSEDED)
    assert bench.ramps.next_due() is None
    ((servo, error),) = bench.cuts
    assert servo == "a"
    assert "replaced before it could leave" in str(error)


def test_a_node_that_goes_offline_ends_its_ramps_and_what_waits_is_not_sent() -> None:
    bench = Bench()
    bench.begin(50).done(Outcome.ACKED)
    (waiting,) = bench.ramps.due(0.1)
    error = ReplyTimeout("offline")
    bench.ramps.end_node(8, error)
    assert not waiting.gone(), "another node"
    bench.ramps.end_node(7, error)
    assert bench.cuts == [("a", error)]
    assert waiting.gone()
    assert bench.ramps.next_due() is None


def test_a_ramp_that_has_not_begun_is_left_to_its_ticket() -> None:
    bench = Bench()
    ticket = bench.begin(50)
    bench.ramps.end_node(7, ReplyTimeout("offline"))
    assert bench.cuts == []
    ticket.done(Outcome.ACKED)
    assert [following.goal.goal.value for following in bench.ramps.due(0.1)] == [20]


def test_a_newer_goal_goes_on_from_the_last_setpoint() -> None:
    bench = Bench()
    older = bench.begin(50)
    older.done(Outcome.ACKED)
    (second,) = bench.ramps.due(0.1)
    second.done(Outcome.ACKED)
    newer = bench.begin(-50, start=0.0, now=0.15)
    assert newer.goal.goal.value == 15, "from 20, where it was last sent half a cycle ago, and not from where it was read"
    assert bench.ramps.due(0.2) == [], "the older ramp has ended"
    newer.done(Outcome.ACKED)
    assert bench.ramps.next_due() == pytest.approx(0.25)


@pytest.mark.parametrize("hz", [3.0, 10.0, 40.0, 1000.0])
def test_a_stream_of_goals_is_no_faster_than_one_goal(hz: float) -> None:
    bench = Bench()
    for number in range(round(hz) + 1):
        bench.begin(1000, now=number / hz).done(Outcome.ACKED)
    assert bench.setpoint == pytest.approx(10 + min(1.0, hz / HZ) * 100)


def test_a_stream_of_which_most_is_superseded_keeps_its_speed() -> None:
    bench = Bench()
    bench.begin(1000).done(Outcome.ACKED)
    for number in range(1, 41):
        bench.begin(1000, now=number / 40).done(Outcome.SUPERSEDED if number % 4 else Outcome.ACKED)
    assert bench.setpoint == pytest.approx(110)


def test_a_caller_replaced_before_its_first_setpoint_left() -> None:
    bench = Bench()
    older = bench.begin(50)
    newer = bench.begin(-50)
    older.done(Outcome.SUPERSEDED)
    newer.done(Outcome.ACKED)
    assert [ticket.goal.goal.value for ticket in bench.ramps.due(0.1)] == [-20]


def test_a_dropped_ramp_ends_and_the_next_one_starts_at_the_last_setpoint() -> None:
    bench = Bench()
    bench.begin(50).done(Outcome.ACKED)
    (late,) = bench.ramps.due(0.1)
    bench.ramps.drop()
    assert bench.ramps.next_due() is None
    late.done(ReplyTimeout("lost"))
    assert bench.cuts == [], "it had ended before"
    assert bench.begin(50, start=3.0, now=0.2).goal.goal.value == 20, "the record still has the last setpoint that was delivered"
    bench.setpoint = None
    assert bench.begin(50, start=3.0, now=0.2).goal.goal.value == 13
    bench.ramps.drop({"a", "b"})
    assert bench.ramps.next_due() is None


def test_a_second_goal_before_the_first_was_delivered_starts_where_the_goal_starts() -> None:
    """No setpoint was sent yet: a goal that was sent as it is would let the servo go there as fast as it can."""
    bench = Bench()
    bench.begin(50, start=0.0)
    assert bench.begin(-50, start=2.0).goal.goal.value == -8
