"""Goals of KST servos, each confirmed by its reply, and stops."""

from __future__ import annotations

from typing import Any

import pytest

from servobus.errors import EchoMismatch, ReplyTimeout
from servobus.protocols.kst.aborts import HardwareFault, OutOfRange
from servobus.protocols.kst.codec import Command, encode, encode_position
from servobus.protocols.kst.goals import HOLDS
from servobus.values import Outcome, StopReport, StopTarget
from tests.protocols.kst.bench import Bench, changed_model, goal


def position_frame(node: int, steps: int) -> bytes:
    return encode(node, Command.SET_POSITION, encode_position(steps))


def move(bench: Bench, *, together: bool = False, confirm: bool = False, **goals: float) -> dict[str, Any]:
    wanted = [goal(name, value) for name, value in goals.items()]
    results: dict[str, Any] = {}
    for turn in bench.driver.plan_goals(wanted, together=together, confirm=confirm):
        results |= bench.run(turn.plan)
    return results


def enabled(**keys: Any) -> Bench:
    bench = Bench(**keys)
    for name in bench.driver.servos:
        bench.run(bench.driver.enable(name))
    bench.frames()
    return bench


def target(servo: str, kind: str = "hold", **keys: Any) -> StopTarget:
    return StopTarget(servo, kind, **{"enabled": True, **keys})  # type: ignore[arg-type]


def test_each_goal_has_a_turn_of_its_own() -> None:
    bench = enabled()
    turns = bench.driver.plan_goals([goal("pan", 10), goal("tilt", -10.9)], together=False, confirm=False)
    assert [(turn.servos, turn.frames) for turn in turns] == [(("pan",), 1), (("tilt",), 1)]
    for turn in turns:
        assert set(bench.run(turn.plan).values()) == {Outcome.ACKED}
    assert bench.frames() == [position_frame(1, 100), position_frame(2, -109)]


@pytest.mark.parametrize("confirm", [True, False])
def test_together_is_one_uninterrupted_plan(confirm: bool) -> None:
    bench = enabled()
    (turn,) = bench.driver.plan_goals([goal("pan", 10), goal("tilt", -10)], together=True, confirm=confirm)
    assert (turn.servos, turn.frames) == (("pan", "tilt"), 2)
    assert bench.run(turn.plan) == {"pan": Outcome.ACKED, "tilt": Outcome.ACKED}
    assert bench.driver.plan_goals([], together=True, confirm=False) == []


def test_what_one_servo_refuses_does_not_keep_the_others() -> None:
    bench = enabled()
    bench.devices[0].refuses = {Command.SET_POSITION: 0x06090030}
    results = move(bench, together=True, pan=10, tilt=20)
    assert isinstance(results["pan"], OutOfRange)
    assert results["pan"].servo == "pan"
    assert results["tilt"] is Outcome.ACKED


def test_the_servo_goes_there_at_its_own_speed() -> None:
    bench = enabled(model=changed_model(max_steps_per_second=1000.0))
    move(bench, pan=90)
    read = bench.driver.read_register("pan", "position")
    bench.exchange(read)
    assert bench.after(0.3).exchange(read) == pytest.approx(30)
    assert bench.after(5).exchange(read) == 90


def test_a_goal_without_reply_is_repeated_and_may_have_been_obeyed() -> None:
    bench = enabled()
    bench.loses = lambda request: True
    assert isinstance(move(bench, pan=10)["pan"], ReplyTimeout)
    assert bench.frames() == [position_frame(1, 100)] * 3
    travel = bench.driver.servos["pan"].travel
    travel.read(100)
    assert not travel.jumped


def test_a_wrong_echo_fails_the_goal() -> None:
    """KST RS422, 3.5: the reply repeats the position."""
    bench = enabled()
    bench.devices[0].answers = {Command.SET_POSITION: encode_position(1)}
    assert isinstance(move(bench, pan=10)["pan"], EchoMismatch)
    lenient = enabled(echo_check="off")
    lenient.devices[0].answers = {Command.SET_POSITION: encode_position(1)}
    assert move(lenient, pan=10)["pan"] is Outcome.ACKED


def test_a_hardware_fault_latches_until_the_servo_is_enabled_again() -> None:
    bench = enabled()
    bench.devices[0].refuses = {Command.SET_POSITION: 0x06060000}
    assert isinstance(move(bench, pan=10)["pan"], HardwareFault)
    bench.devices[0].refuses = {}
    bench.frames()
    assert "nothing was sent" in str(move(bench, pan=10)["pan"])
    assert bench.frames() == []
    assert move(bench, tilt=10)["tilt"] is Outcome.ACKED
    with pytest.raises(HardwareFault, match="enable it again"):
        bench.driver.check_goal(goal("pan", 10))
    assert bench.driver.fault_names("pan", None) == ("hardware fault",)
    bench.run(bench.driver.enable("pan"))
    assert move(bench, pan=10)["pan"] is Outcome.ACKED


# Stops


def test_a_stop_says_the_last_confirmed_setpoint_once_more() -> None:
    """There is no stop command, and a reading may be the goal itself (KST RS422, 3.6)."""
    bench = enabled()
    move(bench, pan=10)
    bench.frames()
    stop = [target("pan", setpoint=10.0), target("tilt", setpoint=0.0)]
    reports = bench.run(bench.driver.stop(stop))
    assert reports == {"pan": StopReport("hold", True, True), "tilt": StopReport("hold", True, True)}
    assert bench.frames() == [position_frame(1, 100), position_frame(2, 0)]
    bench.run(bench.driver.stop([target("pan"), target("tilt")]))
    assert bench.frames() == [position_frame(1, 100), position_frame(2, 0)]


def test_what_was_not_enabled_is_left_alone() -> None:
    bench = Bench()
    reports = bench.run(bench.driver.stop([target("pan", enabled=False)]))
    assert (reports["pan"].action, reports["pan"].written, reports["pan"].confirmed) == ("none", False, True)
    assert bench.frames() == []


def test_limp_is_a_hold_that_says_so() -> None:
    bench = enabled()
    move(bench, pan=-20)
    bench.frames()
    assert bench.run(bench.driver.stop([target("pan", "limp")])) == {"pan": StopReport("hold", True, True, HOLDS)}
    assert bench.frames() == [position_frame(1, -200)]


def test_a_silent_servo_is_stopped_twice_more_after_the_others() -> None:
    bench = enabled()
    bench.loses = lambda request: request.node == 1
    reports = bench.run(bench.driver.stop([target("pan"), target("tilt")]))
    assert list(reports) == ["pan", "tilt"]
    assert (reports["pan"].written, reports["pan"].confirmed) == (True, False)
    assert "no answer" in reports["pan"].detail
    assert reports["tilt"].confirmed
    assert bench.frames() == [*[position_frame(1, 0)] * 3, position_frame(2, 0), *[position_frame(1, 0)] * 2]


def test_an_offline_servo_is_written_to_and_not_waited_for() -> None:
    bench = enabled()
    reports = bench.run(bench.driver.stop([target("pan", reachable=False), target("tilt")]))
    assert reports["pan"] == StopReport("hold", True, False, "offline: nothing was confirmed")
    assert [(request.node, request.replies) for request in bench.sent] == [(2, 1), (1, 0), (1, 0)]


def test_a_stop_reads_a_position_that_it_does_not_have() -> None:
    bench = Bench()
    bench.devices[0].position = bench.devices[0].goal = 333
    assert bench.run(bench.driver.stop([target("pan")]))["pan"].confirmed
    assert bench.frames() == [encode(1, Command.READ_POSITION), position_frame(1, 333)]
    reports = Bench().run(bench.driver.stop([target("tilt", reachable=False)]))
    assert (reports["tilt"].written, reports["tilt"].confirmed) == (False, False)
    assert "its position is not known" in reports["tilt"].detail


def test_a_stop_does_not_send_a_goal_again_that_was_lost() -> None:
    """Nobody knows whether it was obeyed, so the servo is held where it was read last."""
    bench = enabled()
    bench.loses = lambda request: True
    move(bench, pan=40)
    bench.loses = lambda request: False
    bench.frames()
    bench.run(bench.driver.stop([target("pan")]))
    assert bench.frames() == [position_frame(1, 0)]


def test_a_servo_that_has_restarted_is_not_sent_back() -> None:
    """KST RS422, 3.5: after a restart the position is a default value."""
    bench = enabled()
    move(bench, pan=80)
    bench.after(1.0).exchange(bench.driver.read_state("pan"))
    bench.devices[0].reboot(1.0)
    bench.after(1.0).exchange(bench.driver.read_state("pan"))
    bench.exchange(bench.driver.read_state("pan"))
    bench.frames()
    bench.run(bench.driver.stop([target("pan")]))
    (frame,) = bench.frames()
    assert frame == position_frame(1, round(bench.devices[0].position))


def test_a_latched_fault_does_not_keep_a_stop_back() -> None:
    bench = enabled()
    bench.driver.settings.aborts.faulty.add(1)
    assert bench.run(bench.driver.stop([target("pan")]))["pan"].confirmed


def test_disable_closes_the_gate_and_says_nothing() -> None:
    """KST RS422, 3, has no torque, stop or speed command."""
    bench = enabled()
    assert bench.run(bench.driver.disable("pan")) == StopReport("hold", False, True, HOLDS)
    assert bench.frames() == []


def test_previews_are_the_frames_and_change_nothing() -> None:
    bench = Bench()
    goals = [goal("pan", 10), goal("tilt", -10)]
    assert [request.frame for request in bench.driver.preview_goals(goals)] == [position_frame(1, 100), position_frame(2, -100)]
    assert len(bench.driver.preview_stop([target("pan"), target("tilt")])) == 2
    travels = [servo.travel for servo in bench.driver.servos.values()]
    assert [(travel.last, travel.range, travel.jumped) for travel in travels] == [(None, None, False)] * 2
