"""Fences, and how a restart is detected."""

from __future__ import annotations

import pytest

from servobus.errors import ReplyTimeout
from servobus.protocols.fence import choose_key
from servobus.protocols.kst.codec import FACTORY_ID, Command, encode
from servobus.protocols.kst.driver import FENCES
from tests.protocols.kst.bench import Bench, frame_of, goal


def test_a_fence_asks_for_the_id_unless_such_an_answer_is_under_way() -> None:
    assert choose_key(FENCES, ()) == Command.READ_ID
    assert choose_key(FENCES, (Command.SET_POSITION, Command.READ_POSITION)) == Command.READ_ID
    assert choose_key(FENCES, (Command.READ_ID,)) == Command.READ_VERSION
    assert choose_key(FENCES, (Command.READ_VERSION, Command.READ_ID)) == Command.READ_STATUS


@pytest.mark.parametrize("oldest", FENCES)
def test_when_all_are_under_way_the_oldest_is_asked_again(oldest: Command) -> None:
    rest = [command for command in FENCES if command != oldest]
    assert choose_key(FENCES, (Command.SET_POSITION, oldest, *rest)) == oldest


def test_a_fence_that_was_not_answered_is_followed_by_another_kind() -> None:
    bench = Bench()
    bench.loses = lambda request: request.command == Command.READ_ID  # type: ignore[attr-defined]
    assert bench.run(bench.driver.fence(1, [], ()))
    assert bench.frames() == [encode(1, Command.READ_ID), encode(1, Command.READ_VERSION)]
    bench.loses = lambda request: True
    with pytest.raises(ReplyTimeout):
        bench.run(bench.driver.fence(1, [Command.READ_ID], ()))
    assert bench.frames() == [encode(1, Command.READ_VERSION), encode(1, Command.READ_STATUS)]


def test_after_a_fence_the_position_is_read_once() -> None:
    """If it was sent twice, the reply to the first read could be taken for that to the second."""
    bench = Bench()
    bench.run(bench.driver.enable("pan"))
    bench.frames()
    lost = iter((False, True, False, False))
    bench.loses = lambda request: next(lost)
    assert bench.run(bench.driver.fence(1, [], bench.driver.nodes))
    asked = [frame[3] for frame in bench.frames()]
    assert asked == [Command.READ_ID, Command.READ_POSITION, Command.READ_VERSION, Command.READ_POSITION]
    bench.loses = lambda request: request.frame[3] == Command.READ_POSITION
    with pytest.raises(ReplyTimeout):
        bench.run(bench.driver.fence(1, [], bench.driver.nodes))
    assert [frame[3] for frame in bench.frames()] == asked


def test_a_late_answer_never_passes_for_a_newer_one() -> None:
    """The servo replies in order and late: until the reply to the fence, each reply belongs to an older request."""
    bench = Bench()
    asked = bench.driver.read_register("pan", "position")
    plan = bench.driver.fence(1, [asked.reply_key], ())
    first = next(plan)
    second = plan.throw(ReplyTimeout("late"))
    late = [frame_of(encode(1, 0x40 + request.frame[3], b"\1")) for request in (asked, first, second)]
    assert [second.answers(reply) for reply in late] == [False, False, True]
    assert [first.answers(reply) for reply in late] == [False, True, False]


def test_after_a_new_id_the_fence_knows_both() -> None:
    bench = Bench()
    bench.run(bench.driver.commissioning.set_id(1, 7))
    assert bench.run(bench.driver.fence(1, [], ()))
    assert bench.frames()[-1] == encode(1, Command.READ_ID)
    bench.devices[0].answers = {Command.READ_ID: b"\7"}
    assert bench.run(bench.driver.fence(1, [], ()))
    assert bench.frames() == [encode(1, Command.READ_ID)]
    bench.devices[0].answers = {Command.READ_ID: b"\x08"}
    assert bench.run(bench.driver.fence(1, [], ()))
    assert bench.frames() == [encode(1, Command.READ_ID), encode(1, Command.READ_VERSION)]


def test_a_servo_that_stands_where_nobody_sent_it_has_restarted() -> None:
    """KST RS422, 3.5: after a restart the position is a default value."""
    bench = Bench()
    bench.run(bench.driver.enable("pan"))
    assert bench.run(bench.driver.fence(1, [], bench.driver.nodes))
    for turn in bench.driver.plan_goals([goal("pan", 60)], together=False, confirm=False):
        bench.run(turn.plan)
    assert bench.after(1).run(bench.driver.fence(1, [], bench.driver.nodes))
    bench.devices[0].reboot(1.0)
    bench.devices[0].goal = -300.0
    bench.after(1)
    assert bench.run(bench.driver.fence(1, [], ()))
    assert not bench.after(1).run(bench.driver.fence(1, [], bench.driver.nodes))
    assert bench.driver.fault_names("pan", None) == ("restarted",)
    bench.run(bench.driver.enable("pan"))
    assert bench.run(bench.driver.fence(1, [], bench.driver.nodes))


def test_a_restart_that_changes_nothing_is_not_detected() -> None:
    bench = Bench()
    bench.run(bench.driver.enable("pan"))
    bench.devices[0].reboot(0.0)
    assert bench.after(1).run(bench.driver.fence(1, [], bench.driver.nodes))


def test_a_servo_that_refuses_to_say_where_it_stands_is_believed() -> None:
    bench = Bench()
    bench.devices[0].refuses = {Command.READ_POSITION: 0x06010000}
    assert bench.run(bench.driver.fence(1, [], bench.driver.nodes))


def test_a_node_nobody_configured_can_be_fenced_too() -> None:
    bench = Bench({})
    bench.devices.append(Bench({"x": {"id": FACTORY_ID}}).devices[0])
    assert bench.run(bench.driver.fence(FACTORY_ID, [], bench.driver.nodes))
