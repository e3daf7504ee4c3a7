"""How goals leave: WRITE, SYNC WRITE, or REG WRITE and ACTION, and what becomes of a servo that does not acknowledge."""

from __future__ import annotations

import pytest

from servobus.errors import ActionWithheld, ReplyTimeout
from servobus.protocols.sms.codec import Instruction, Packet
from servobus.protocols.sms.goals import MAX_FRAME_SECONDS, max_frame_size
from servobus.values import Goal, Outcome, ServoGoal
from tests.protocols.sms.bench import TWO, Bench

MANY = {f"s{number}": {"id": number, "model": "sts"} for number in range(1, 41)}
FLAG = 64


def writes_of(bench: Bench, code: Instruction) -> list[Packet]:
    return [packet for packet in bench.sent if packet.code == code]


def test_the_documented_frame_of_a_goal() -> None:
    bench = Bench({"elbow": {"id": 2, "model": "sts", "zero": 2048, "direction": -1}})
    bench.enable()
    assert bench.move({"elbow": 30}) == {"elbow": Outcome.ACKED}
    assert [packet.frame.hex(" ").upper() for packet in bench.sent] == ["FF FF 02 09 03 2A AB 06 00 00 E8 03 2B"]
    assert bench.register(2, "goal_position") == 1707


def test_several_goals_are_one_sync_write() -> None:
    bench = Bench()
    bench.enable()
    assert bench.move({"a": 10, "b": -10}) == {"a": Outcome.SENT, "b": Outcome.SENT}
    assert bench.instructions() == ["SYNC_WRITE"]
    assert (bench.register(1, "goal_position"), bench.register(2, "goal_position")) == (2162, 1934)


def test_confirm_is_reg_write_each_and_one_action() -> None:
    bench = Bench()
    bench.enable()
    assert bench.move({"a": 10, "b": -10}, confirm=True) == {"a": Outcome.ACKED, "b": Outcome.ACKED}
    assert bench.instructions() == ["REG_WRITE", "REG_WRITE", "ACTION"]
    assert bench.register(1, "goal_position") == 2162


def test_confirm_of_one_is_its_acknowledged_write() -> None:
    bench = Bench()
    bench.enable()
    bench.move({"a": 10}, confirm=True)
    assert bench.instructions() == ["WRITE"]


def test_different_spans_are_reg_write_and_action() -> None:
    bench = Bench()
    bench.enable()
    goals = {"a": Goal("position", 10, acceleration=500), "b": Goal("position", 10)}
    assert bench.move(goals) == {"a": Outcome.ACKED, "b": Outcome.ACKED}
    assert bench.instructions() == ["REG_WRITE", "REG_WRITE", "ACTION"]
    assert {packet.id: packet.params[0] for packet in writes_of(bench, Instruction.REG_WRITE)} == {1: 41, 2: 42}
    bench.sent.clear()
    bench.move(goals)
    assert bench.instructions() == ["SYNC_WRITE"], "the servo holds the acceleration now"


@pytest.mark.parametrize(("count", "frames"), [(17, 1), (18, 2), (34, 2), (35, 3)])
def test_sync_write_is_split_at_its_maximum_size(count: int, frames: int) -> None:
    """128 bytes hold 8 + 17 x 7."""
    bench = Bench(dict(list(MANY.items())[:count]))
    bench.enable()
    results = bench.move(dict.fromkeys(bench.driver.nodes, 1.0))
    assert set(results.values()) == {Outcome.SENT} or frames > 1
    assert len(results) == count
    assert len(bench.sent) == frames
    assert all(len(packet.frame) <= 128 for packet in bench.sent)


@pytest.mark.parametrize(("baudrate", "size"), [(115_200, 115), (1_000_000, 128), (9600, 9)])
def test_no_frame_holds_the_line_longer_than_allowed(baudrate: int, size: int) -> None:
    assert max_frame_size(Bench(baudrate=baudrate).options) == size
    assert size * 10 / baudrate <= MAX_FRAME_SECONDS


def test_a_frame_carries_one_servo_or_more() -> None:
    bench = Bench(baudrate=9600)
    bench.enable()
    assert set(bench.move({"a": 1, "b": 1}).values()) == {Outcome.ACKED}
    assert bench.instructions() == ["WRITE", "WRITE"]


def test_together_beyond_one_frame_is_reg_write_and_action() -> None:
    bench = Bench(dict(list(MANY.items())[:18]))
    bench.enable()
    turns = bench.driver.plan_goals(
        [ServoGoal(name, Goal("position", 1.0)) for name in bench.driver.nodes], together=True, confirm=False
    )
    assert [(len(turn.servos), turn.frames) for turn in turns] == [(18, 19)]
    assert set(bench.run(turns[0].plan).values()) == {Outcome.ACKED}
    assert bench.instructions() == ["REG_WRITE"] * 18 + ["ACTION"]


# A servo that does not acknowledge


def test_action_is_withheld_and_armed_servos_are_disarmed() -> None:
    bench = Bench()
    bench.enable()
    goals = bench.register(1, "goal_position"), bench.register(2, "goal_position")
    bench.is_lost = lambda packet: packet.id == 2
    results = bench.move({"a": 10, "b": 10}, confirm=True)
    assert isinstance(results["a"], ActionWithheld)
    assert "b did not acknowledge" in str(results["a"])
    assert isinstance(results["b"], ReplyTimeout)
    assert not any(packet.code == Instruction.ACTION and packet.id == 0xFE for packet in bench.sent)
    assert bench.register(1, "async_write_flag") == 0, "disarmed"
    assert (bench.register(1, "goal_position"), bench.register(2, "goal_position")) == goals


def test_a_lost_acknowledgement_withholds_the_next_action() -> None:
    bench = Bench({**TWO, "c": {"id": 3, "model": "sts"}})
    bench.enable()
    goal = bench.register(3, "goal_position")
    bench.is_unanswered = lambda packet: packet.id == 3
    bench.move({"a": 10, "c": 10}, confirm=True)
    assert bench.register(3, "async_write_flag") == 1, "it is armed, and nobody knows"
    results = bench.move({"a": 5, "b": 5}, confirm=True)
    assert all(isinstance(result, ActionWithheld) for result in results.values())
    assert "c may hold an older REG WRITE" in str(results["a"])
    assert bench.register(3, "goal_position") == goal
    bench.is_unanswered = lambda packet: False
    assert bench.move({"a": 5, "b": 5}, confirm=True) == {"a": Outcome.ACKED, "b": Outcome.ACKED}, (
        "it answers, and is disarmed first"
    )
    assert bench.register(3, "goal_position") == goal


def test_a_flag_of_0_permits_the_next_action() -> None:
    bench = Bench({**TWO, "c": {"id": 3, "model": "sts"}})
    bench.enable()
    bench.is_lost = lambda packet: packet.id == 3
    bench.move({"a": 10, "c": 10}, confirm=True)
    bench.is_lost = lambda packet: False
    bench.sent.clear()
    assert bench.move({"a": 5, "b": 5}, confirm=True) == {"a": Outcome.ACKED, "b": Outcome.ACKED}
    assert any(packet.id == 3 and packet.params == bytes((FLAG, 1)) for packet in bench.sent)


def test_on_partial_go_moves_those_that_are_armed() -> None:
    bench = Bench(on_partial="go")
    bench.enable()
    bench.is_lost = lambda packet: packet.id == 2
    results = bench.move({"a": 10, "b": 10}, confirm=True)
    assert results["a"] is Outcome.ACKED
    assert isinstance(results["b"], ReplyTimeout)
    assert bench.register(1, "goal_position") == 2162


def test_nobody_acknowledges() -> None:
    bench = Bench(on_partial="go")
    bench.enable()
    bench.is_lost = lambda packet: True
    results = bench.move({"a": 10, "b": 10}, confirm=True)
    assert all(isinstance(result, ReplyTimeout) for result in results.values())
    assert "ACTION" not in bench.instructions()


def test_a_servo_that_cannot_be_disarmed_stays_suspect() -> None:
    bench = Bench()
    bench.enable()
    bench.is_lost = lambda packet: packet.id == 2 or (packet.code == Instruction.REG_WRITE and packet.params[0] != 42)
    bench.move({"a": 10, "b": 10}, confirm=True)
    assert bench.register(1, "async_write_flag") == 1
    bench.is_lost = lambda packet: False
    results = bench.move({"b": 1, "a": Goal("position", 1, acceleration=900)}, confirm=True)
    assert results == {"b": Outcome.ACKED, "a": Outcome.ACKED}, "overwritten"


# Servos that answer no write


def test_without_acknowledgements_nothing_is_waited_for() -> None:
    bench = Bench(status_return="read_only")
    bench.enable()
    assert bench.move({"a": 10}) == {"a": Outcome.SENT}
    assert bench.instructions() == ["WRITE"]


def test_without_acknowledgements_the_flag_confirms() -> None:
    bench = Bench(status_return="read_only")
    bench.enable()
    assert bench.move({"a": 10, "b": 10}, confirm=True) == {"a": Outcome.ACKED, "b": Outcome.ACKED}
    assert bench.instructions() == ["REG_WRITE", "READ", "REG_WRITE", "READ", "ACTION"]
    assert bench.move({"a": 3}, confirm=True) == {"a": Outcome.ACKED}
    bench.is_lost = lambda packet: packet.id == 2 and packet.code == Instruction.REG_WRITE
    results = bench.move({"a": 5, "b": 5}, confirm=True)
    assert "its flag reads 0" in str(results["b"])
    assert isinstance(results["a"], ActionWithheld)
