"""The coalescer: the newest goal wins, groups leave whole, nothing old is replayed."""

from __future__ import annotations

from typing import Any

from servobus.engine.coalescer import Coalescer, Group, Ticket
from servobus.errors import ActionWithheld, GoalExpired, NotEnabled, ServobusError
from servobus.values import Outcome
from tests.engine.toy_protocol import ticket

Ended = list[tuple[str, Any]]
ALL = (1, 2, 3, 4)


def coalescer_of(*tickets: Ticket) -> Coalescer:
    coalescer = Coalescer()
    for each in tickets:
        coalescer.put(each)
    return coalescer


def names(group: Group | None) -> list[str]:
    return [] if group is None else [each.servo for each in group.tickets]


def kinds(ended: Ended) -> list[tuple[str, Any]]:
    return [(servo, type(result) if isinstance(result, Exception) else result) for servo, result in ended]


def disabled(servo: str) -> ServobusError:
    return NotEnabled("it was disabled", servo=servo)


def test_goals_of_several_servos_leave_together_in_the_order_they_came() -> None:
    ended: Ended = []
    coalescer = coalescer_of(ticket(2, ended), ticket(1, ended), ticket(3, ended))
    group = coalescer.take(0.0, ALL)
    assert names(group) == ["s2", "s1", "s3"]
    assert group is not None
    assert (group.together, group.confirm) == (False, False)
    assert (len(coalescer), ended) == (0, [])
    assert coalescer.take(0.0, ALL) is None


def test_a_newer_goal_supersedes_the_older_and_keeps_its_turn() -> None:
    ended: Ended = []
    newer = ticket(1, ended)
    coalescer = coalescer_of(ticket(1, ended), ticket(2, ended), newer)
    assert kinds(ended) == [("s1", Outcome.SUPERSEDED)]
    assert len(coalescer) == 2
    group = coalescer.take(0.0, ALL)
    assert group is not None
    assert group.tickets[0] is newer


def test_a_goal_lives_until_its_time_to_live_and_not_at_it() -> None:
    ended: Ended = []
    coalescer = coalescer_of(ticket(1, ended, expires=1.0), ticket(2, ended, expires=1.1))
    assert coalescer.next_expiry() == 1.0
    coalescer.expire(0.999)
    assert ended == []
    assert names(coalescer.take(1.0, ALL)) == ["s2"]
    assert kinds(ended) == [("s1", GoalExpired)]
    assert ended[0][1].servo == "s1"
    assert coalescer.next_expiry() is None


def test_only_servos_that_are_ready_leave_and_the_others_wait() -> None:
    ended: Ended = []
    coalescer = coalescer_of(ticket(1, ended), ticket(2, ended))
    assert names(coalescer.take(0.0, (2,))) == ["s2"]
    assert coalescer.take(0.0, (2,)) is None
    assert len(coalescer) == 1
    assert names(coalescer.take(0.0, (1, 2))) == ["s1"]


def test_a_batch_leaves_whole_or_not_at_all_and_holds_nobody_back() -> None:
    ended: Ended = []
    coalescer = coalescer_of(ticket(1, ended, batch=7), ticket(2, ended, batch=7), ticket(3, ended))
    assert names(coalescer.take(0.0, (1, 3))) == ["s3"]
    assert coalescer.take(0.0, (1, 3)) is None
    group = coalescer.take(0.0, (1, 2, 3))
    assert names(group) == ["s1", "s2"]
    assert group is not None
    assert group.together


def test_batches_do_not_mix() -> None:
    ended: Ended = []
    coalescer = coalescer_of(*(ticket(number, ended, batch=number % 2) for number in (1, 2, 3, 4)))
    assert names(coalescer.take(0.0, ALL)) == ["s1", "s3"]
    assert names(coalescer.take(0.0, ALL)) == ["s2", "s4"]


def test_goals_to_be_confirmed_leave_apart_from_the_others() -> None:
    ended: Ended = []
    coalescer = coalescer_of(ticket(1, ended), ticket(2, ended, confirm=True), ticket(3, ended), ticket(4, ended, confirm=True))
    assert names(coalescer.take(0.0, ALL)) == ["s1", "s3"]
    group = coalescer.take(0.0, ALL)
    assert names(group) == ["s2", "s4"]
    assert group is not None
    assert group.confirm


def test_a_superseded_member_leaves_its_batch_and_the_rest_goes_in_one_turn() -> None:
    ended: Ended = []
    coalescer = coalescer_of(*(ticket(number, ended, batch=1) for number in (1, 2, 3)))
    coalescer.put(ticket(1, ended))
    assert kinds(ended) == [("s1", Outcome.SUPERSEDED)]
    assert names(coalescer.take(0.0, ALL)) == ["s1"]
    group = coalescer.take(0.0, ALL)
    assert names(group) == ["s2", "s3"]
    assert group is not None
    assert group.together


def test_when_a_member_expires_its_batch_is_withheld() -> None:
    ended: Ended = []
    coalescer = coalescer_of(ticket(1, ended, expires=1.0, batch=1), ticket(2, ended, expires=2.0, batch=1), ticket(3, ended))
    assert names(coalescer.take(1.0, ALL)) == []
    assert kinds(ended) == [("s1", GoalExpired), ("s3", GoalExpired), ("s2", ActionWithheld)]
    assert "s1" in str(ended[2][1])
    assert len(coalescer) == 0


def test_a_goal_whose_caller_left_is_dropped_without_a_result() -> None:
    ended: Ended = []
    left = False
    coalescer = coalescer_of(ticket(1, ended, gone=lambda: left), ticket(2, ended))
    coalescer.expire(0.0)
    assert len(coalescer) == 2
    left = True
    assert names(coalescer.take(0.0, ALL)) == ["s2"]
    assert ended == []


def test_when_the_caller_of_a_member_left_its_batch_is_withheld() -> None:
    ended: Ended = []
    coalescer = coalescer_of(ticket(1, ended, batch=1, gone=lambda: True), ticket(2, ended, batch=1))
    assert coalescer.take(0.0, ALL) is None
    assert kinds(ended) == [("s2", ActionWithheld)]


def test_drop_ends_the_goals_of_some_servos_and_withholds_their_batches() -> None:
    ended: Ended = []
    coalescer = coalescer_of(ticket(1, ended, batch=1), ticket(2, ended, batch=1), ticket(3, ended), ticket(4, ended))
    coalescer.drop(disabled, {"s1", "s4"})
    assert kinds(ended) == [("s1", NotEnabled), ("s4", NotEnabled), ("s2", ActionWithheld)]
    assert names(coalescer.take(0.0, ALL)) == ["s3"]


def test_drop_ends_everything() -> None:
    ended: Ended = []
    coalescer = coalescer_of(ticket(1, ended, batch=1), ticket(2, ended))
    coalescer.drop(disabled)
    assert kinds(ended) == [("s1", NotEnabled), ("s2", NotEnabled)]
    assert len(coalescer) == 0


def test_what_could_not_leave_waits_again_unless_a_newer_goal_has_come() -> None:
    ended: Ended = []
    coalescer = coalescer_of(ticket(1, ended), ticket(2, ended))
    group = coalescer.take(0.0, ALL)
    assert group is not None
    newer = ticket(1, ended)
    coalescer.put(newer)
    for each in group.tickets:
        coalescer.put_back(each)
    assert kinds(ended) == [("s1", Outcome.SUPERSEDED)]
    again = coalescer.take(0.0, ALL)
    assert again is not None
    assert list(again.tickets) == [newer, group.tickets[1]]


def test_a_stream_to_a_dead_servo_hears_that_it_expired() -> None:
    """Each goal replaces the one before it, and none can leave: from the first one's time on that is the answer."""
    ended: Ended = []
    coalescer = Coalescer()
    for count in range(8):
        at = count * 0.1
        coalescer.put(ticket(1, ended, expires=at + 0.25, put_at=at))
    assert kinds(ended) == [("s1", Outcome.SUPERSEDED)] * 2 + [("s1", GoalExpired)] * 5


def test_a_stream_that_leaves_now_and_then_is_superseded_only() -> None:
    ended: Ended = []
    coalescer = Coalescer()
    for count in range(8):
        at = count * 0.1
        coalescer.put(ticket(1, ended, expires=at + 0.25, put_at=at))
        if count % 2:
            assert coalescer.take(at, ALL) is not None
    assert kinds(ended) == [("s1", Outcome.SUPERSEDED)] * 4


def test_a_group_that_expires_names_the_servo_that_it_waited_for() -> None:
    ended: Ended = []
    coalescer = coalescer_of(ticket(1, ended, batch=1), ticket(2, ended, batch=1))
    assert coalescer.take(0.5, (1,)) is None
    coalescer.expire(1.0, (1,))
    assert kinds(ended) == [("s2", GoalExpired), ("s1", ActionWithheld)]
    assert "together with s2" in str(ended[1][1])
