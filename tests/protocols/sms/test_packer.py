"""A goal is packed once: what its check returned is used again, unless something that counts has changed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from servobus.protocols.sms.packer import PackedGoal
from servobus.protocols.sms.servo import Fit
from servobus.values import Goal, ServoGoal
from tests.protocols.sms.bench import Bench
from tests.protocols.sms.single_servo import changed

COMMANDS = "01 fe 00 08 00 00 e8 03 e8 03 00 00 00 00 00 01 "
"""The registers 40 to 55 in front of the measured ones."""


def enabled() -> Bench:
    bench = Bench()
    bench.enable()
    return bench


def checked(bench: Bench, goal: ServoGoal) -> ServoGoal:
    return replace(goal, packed=bench.driver.check_goal(goal))


def is_reused(bench: Bench, goal: ServoGoal) -> bool:
    """Plans and sends the goal; whether its check had packed these bytes, and not merely equal ones."""
    assert isinstance(goal.packed, PackedGoal)
    reused = goal.packed.is_for(goal)
    bench.sent.clear()
    (turn,) = bench.driver.plan_goals([goal], together=False, confirm=False)
    bench.run(turn.plan)
    fresh = bench.driver.check_goal(goal)
    assert bench.sent[0].params[1:] == goal.packed.data if reused else fresh.data
    return reused


def test_a_checked_goal_is_not_packed_again() -> None:
    bench = enabled()
    assert is_reused(bench, checked(bench, ServoGoal("a", Goal("position", 10.0))))
    assert is_reused(bench, checked(bench, ServoGoal("a", Goal("position", 10.0, duration=1.0), 0.0)))


def another_goal(bench: Bench, goal: ServoGoal) -> ServoGoal:
    return replace(goal, goal=Goal("position", 20.0, duration=1.0))


def another_start(bench: Bench, goal: ServoGoal) -> ServoGoal:
    return replace(goal, start=5.0)


def another_setting(bench: Bench, goal: ServoGoal) -> ServoGoal:
    bench.driver.servos["a"].hold({"acceleration": 7})
    return goal


def another_fit(bench: Bench, goal: ServoGoal) -> ServoGoal:
    bench.driver.servos["a"].learn(Fit(response_level=1))
    return goal


@pytest.mark.parametrize("change", [another_goal, another_start, another_setting, another_fit])
def test_a_change_packs_the_goal_again(change: Callable[[Bench, ServoGoal], ServoGoal]) -> None:
    bench = enabled()
    goal = checked(bench, ServoGoal("a", Goal("position", 10.0, duration=1.0), 0.0))
    changed_goal = change(bench, goal)
    expected = bench.driver.check_goal(replace(changed_goal, packed=None)).data
    assert not is_reused(bench, changed_goal)
    assert bench.sent[0].params[1:] == expected


def test_an_equal_report_does_not_count_as_a_change() -> None:
    bench = enabled()
    goal = checked(bench, ServoGoal("a", Goal("position", 10.0)))
    bench.driver.servos["a"].learn(replace(bench.driver.servos["a"].fit))
    bench.driver.servos["a"].hold({})
    assert is_reused(bench, goal)


def test_a_preview_has_the_frames_of_goals_and_changes_nothing() -> None:
    bench = Bench({f"s{number}": {"id": number, "model": "sts"} for number in range(1, 19)})
    goals = [ServoGoal(name, Goal("position", 1.0)) for name in bench.driver.nodes]
    servos = bench.driver.servos.values()
    before = [(servo.held, servo.fit) for servo in servos]
    frames = [request.frame for request in bench.driver.preview_goals(goals)]
    assert [(servo.held, servo.fit) for servo in servos] == before
    bench.enable()
    bench.move(dict.fromkeys(bench.driver.nodes, 1.0))
    assert frames == [packet.frame for packet in bench.sent]
    assert bench.driver.preview_goals([]) == []


def test_a_preview_of_different_models_is_reg_write_and_action() -> None:
    bench = Bench({"a": {"id": 1, "model": "sts"}, "w": {"id": 2, "model": "sts"}})
    bench.driver.servos["w"].learn(Fit("velocity"))
    goals = [ServoGoal("a", Goal("position", 1.0)), ServoGoal("w", Goal("velocity", 1.0))]
    names = [type(request).__name__ for request in bench.driver.preview_goals(goals)]
    assert names == ["RegWrite", "RegWrite", "Action"]


def test_overlapping_state_registers_are_both_decoded() -> None:
    """A model file of one's own may name a second register on the same bytes."""
    model = changed("sts", load_byte={"address": 60, "size": 1, "access": "r"})
    model = type(model).model_validate({**model.model_dump(), "state": {**model.state, "current": "load_byte"}})
    bench = Bench(sts=model)
    update = bench.driver.servos["a"].decode_state(bytes.fromhex(COMMANDS + "00 0c 00 84 f4 05 4a 1e 00 20 01 00 08 64 00"))
    assert (update["load"], update["current"], update["position"]) == (-50.0, 0xF4, 90.0)
