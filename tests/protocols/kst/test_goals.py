"""Goals of KST servos, each confirmed by its reply, and stops."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest

from servobus.errors import EchoMismatch, LimitError, NotEnabled, ReplyTimeout
from servobus.protocols.kst.aborts import HardwareFault, OutOfRange
from servobus.protocols.kst.codec import Command, decode_position, encode, encode_position
from servobus.protocols.kst.goals import HOLDS, MAX_WAITS, OFFLINE
from servobus.values import Loss, Outcome, StopReport, StopTarget
from tests.protocols.kst.bench import Bench, bus_options, changed_model, goal


def position_frame(node: int, steps: int) -> bytes:
    return encode(node, Command.SET_POSITION, encode_position(steps))


def move(bench: Bench, *, together: bool = False, confirm: bool = False, **goals: float) -> dict[str, Any]:
    wanted = [goal(name, value) for name, value in goals.items()]
    results: dict[str, Any] = {}
    for turn in bench.driver.plan_goals(wanted, together=together, confirm=confirm):
        results |= bench.run(turn.plan)
    return results


def read_frame(node: int) -> bytes:
    return encode(node, Command.READ_POSITION)


def held(*steps: int) -> list[bytes]:
    """Return the frames that hold pan, or pan and tilt, there: read, sent, and read twice again."""
    reads = [read_frame(node) for node in range(1, len(steps) + 1)]
    return [frame for read, raw in zip(reads, steps, strict=True) for frame in (read, position_frame(read[2], raw))] + 2 * reads


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
    bench.after(1).frames()
    stop = [target("pan", setpoint=10.0), target("tilt", setpoint=0.0)]
    reports = bench.run(bench.driver.stop(stop))
    assert reports == {"pan": StopReport("hold", True, True), "tilt": StopReport("hold", True, True)}
    assert bench.frames() == held(100, 0)
    bench.run(bench.driver.stop([target("pan"), target("tilt")]))
    assert bench.frames() == held(100, 0)


def test_what_was_not_enabled_is_left_alone() -> None:
    bench = Bench()
    reports = bench.run(bench.driver.stop([target("pan", enabled=False)]))
    assert (reports["pan"].action, reports["pan"].written, reports["pan"].confirmed) == ("none", False, True)
    assert bench.frames() == [read_frame(1)] * 2


def test_limp_is_a_hold_that_says_so() -> None:
    bench = enabled()
    move(bench, pan=-20)
    bench.after(1).frames()
    assert bench.run(bench.driver.stop([target("pan", "limp")])) == {"pan": StopReport("hold", True, True, HOLDS)}
    assert bench.frames() == held(-200)


def test_a_silent_servo_is_sent_nothing_and_keeps_no_other() -> None:
    """It goes no farther than its last setpoint, and a position would move it if it has restarted (KST RS422, 3.5)."""
    bench = enabled()
    bench.loses = lambda request: request.node == 1
    reports = bench.run(bench.driver.stop([target("pan"), target("tilt")]))
    assert list(reports) == ["pan", "tilt"]
    assert (reports["pan"].written, reports["pan"].confirmed) == (False, False)
    assert "no answer" in reports["pan"].detail
    assert reports["tilt"].confirmed
    assert bench.frames() == [*[read_frame(1)] * 3, read_frame(2), position_frame(2, 0), read_frame(2), read_frame(2)]
    assert bench.driver.blind_stop(target("pan", setpoint=30.0)) == ()


def test_an_offline_servo_is_not_waited_for() -> None:
    bench = enabled()
    reports = bench.run(bench.driver.stop([target("pan", reachable=False, position=10.0, setpoint=30.0), target("tilt")]))
    assert reports["pan"] == StopReport("hold", False, False, OFFLINE)
    assert {request.node for request in bench.sent} == {2}


def test_a_stop_reads_a_position_that_it_does_not_have() -> None:
    bench = Bench()
    bench.devices[0].position = bench.devices[0].goal = 333
    assert bench.run(bench.driver.stop([target("pan")]))["pan"].confirmed
    assert bench.frames() == [read_frame(1), *held(333)], "nobody knows where it can be, so one reading is not enough"


def test_a_stop_does_not_send_a_goal_again_that_was_lost() -> None:
    """Nobody knows whether it was obeyed, so the servo is held where it is read."""
    bench = enabled()
    bench.loses = lambda request: True
    bench.devices[0].dead = True
    move(bench, pan=40)
    bench.loses = lambda request: False
    bench.devices[0].dead = False
    bench.frames()
    bench.run(bench.driver.stop([target("pan")]))
    assert bench.frames() == held(0)


def test_a_servo_that_has_restarted_is_held_where_it_is() -> None:
    """KST RS422, 3.5: after a restart the position is a default value. No poll fell into the gap."""
    bench = enabled()
    move(bench, pan=80)
    bench.after(1.0).exchange(bench.driver.read_state("pan"))
    bench.devices[0].reboot(1.0)
    bench.after(3.0).frames()
    assert bench.devices[0].goal == 0
    report = bench.run(bench.driver.stop([target("pan", setpoint=80.0)]))["pan"]
    assert report.confirmed
    assert bench.frames() == [read_frame(1), *held(0)]


def test_a_stop_is_confirmed_only_when_the_servo_rests() -> None:
    """The reply to set position repeats what was sent (KST RS422, 3.5): it tells nothing of what the servo does."""
    bench = enabled(model=changed_model(max_steps_per_second=200.0))
    move(bench, pan=80)
    bench.devices[0].ignores_goals = True
    report = bench.after(0.5).run(bench.driver.stop([target("pan", setpoint=80.0)]))["pan"]
    assert (report.written, report.confirmed) == (True, False)
    assert "it still moves: it was read at" in report.detail
    bench.devices[0].ignores_goals = False
    assert bench.run(bench.driver.stop([target("pan")]))["pan"].confirmed
    bench.after(1.0)
    assert bench.exchange(bench.driver.read_register("pan", "position")) < 25


def test_a_stop_whose_readings_are_lost_is_not_confirmed() -> None:
    bench = enabled()
    sent = iter(range(100))
    bench.loses = lambda request: next(sent) > 1
    report = bench.run(bench.driver.stop([target("pan")]))["pan"]
    assert (report.written, report.confirmed) == (True, False)
    assert "not read again" in report.detail


@pytest.mark.parametrize("altered", [900, -900, 300])
def test_one_altered_reading_moves_no_servo_that_is_stopped(altered: int) -> None:
    bench = enabled()
    bench.altered = [altered]
    assert bench.run(bench.driver.stop([target("pan", setpoint=0.0)]))["pan"].confirmed
    assert [frame for frame in bench.frames() if frame[3] == Command.SET_POSITION] == [position_frame(1, 0)]


# Setpoints of a ramp


def send_setpoint(bench: Bench, value: float, lead: float = 1.2) -> tuple[Any, float | None]:
    """Send one setpoint of a ramp: its outcome or its error, and the position that was sent instead."""
    setpoint = goal("pan", value, lead=lead)
    (plan,) = bench.driver.plan_goals([setpoint], together=False, confirm=False)
    return bench.run(plan.plan)["pan"], setpoint.applied


def positions_sent(bench: Bench) -> list[int]:
    return [decode_position(frame[4:]) for frame in bench.frames() if frame[3] == Command.SET_POSITION]


def test_a_setpoint_follows_a_reading() -> None:
    bench = enabled()
    assert send_setpoint(bench, 1.2) == (Outcome.ACKED, None)
    assert bench.frames() == [read_frame(1), position_frame(1, 12)]


def test_a_setpoint_follows_a_verification_without_another_reading() -> None:
    bench = enabled()
    verify(bench, "pan", "tilt")
    bench.frames()
    send_setpoint(bench, 1.2)
    send_setpoint(bench.after(1), 2.4)
    assert bench.frames() == [position_frame(1, 12), read_frame(1), position_frame(1, 24)]


def verify(bench: Bench, *servos: str) -> Mapping[str, Loss]:
    plan = bench.driver.verify(servos)
    assert plan is not None
    return bench.run(plan)


def test_a_servo_whose_setpoints_were_lost_goes_on_from_where_it_is() -> None:
    bench = enabled()
    bench.devices[0].dead = True
    assert isinstance(send_setpoint(bench, 1.2)[0], ReplyTimeout)
    bench.devices[0].dead = False
    assert send_setpoint(bench, 66.0) == (Outcome.ACKED, 1.2), "heard again, it is not sent 66 degrees"
    assert positions_sent(bench) == [12]


def test_a_servo_that_lags_keeps_the_goal_that_it_holds() -> None:
    bench = enabled(model=changed_model(max_steps_per_second=10.0))
    send_setpoint(bench, 1.2)
    bench.after(0.1)
    assert send_setpoint(bench, 2.4) == (Outcome.ACKED, 1.3)
    bench.devices[0].position = 0.0
    assert send_setpoint(bench, 2.5) == (Outcome.ACKED, 1.3)
    assert positions_sent(bench) == [12, 13]


def test_a_servo_that_comes_no_nearer_to_its_goal_is_given_up() -> None:
    bench = enabled()
    send_setpoint(bench, 1.2)
    bench.devices[0].room = (-20.0, -10.0)
    bench.after(1)
    results = [send_setpoint(bench, 2.4)[0] for _ in range(MAX_WAITS + 1)]
    assert set(results[: MAX_WAITS - 1]) == {Outcome.ACKED}
    assert "it does not follow: it is at -1 and its goal is 1.2" in str(results[-1])
    assert positions_sent(bench) == [12]


def test_a_servo_that_has_restarted_is_sent_no_setpoint() -> None:
    """KST RS422, 3.5. Two readings say so, because one may be an altered reply."""
    bench = enabled()
    for number in range(1, 60):
        send_setpoint(bench.after(0.02), 1.2 * number)
    bench.devices[0].reboot(bench.now)
    bench.after(3).frames()
    error, _ = send_setpoint(bench, 72.0)
    assert isinstance(error, NotEnabled)
    assert "it is at 0, where it was not sent" in error.message
    assert bench.frames() == [read_frame(1)] * 2
    assert verify(bench, "pan", "tilt") == {"pan": Loss.RESTARTED}


@pytest.mark.parametrize("altered", [900, -900, 100])
def test_one_altered_reading_changes_no_setpoint(altered: int) -> None:
    bench = enabled()
    send_setpoint(bench, 1.2)
    bench.after(1)
    bench.altered = [altered]
    assert send_setpoint(bench, 2.4) == (Outcome.ACKED, None)
    assert positions_sent(bench) == [12, 24]


def test_a_servo_that_does_not_answer_shows_nothing() -> None:
    bench = enabled()
    bench.devices[0].mute = True
    assert verify(bench, "pan", "tilt") == {}
    bench.devices[0].mute = False
    bench.devices[0].refuses = {Command.READ_POSITION: 0x06010000}
    assert verify(bench, "pan") == {}


def test_limits_and_speeds_are_taken_while_the_servo_is_enabled() -> None:
    bench = enabled()
    servos: dict[str, Any] = {"pan": {"id": 1, "speed": 30, "limits": [-40, 40], "range_deg": [-50, 50]}, "tilt": {"id": 2}}
    assert bench.driver.use_options(bus_options(servos, poll={"feedback": 40}))
    assert bench.driver.host_speed(goal("pan", 10)) == 30
    with pytest.raises(LimitError, match="-50 to 50"):
        bench.driver.check_goal(goal("pan", 60))
    assert bench.driver.servos["pan"].travel.range == (0, 0), "what was learned remains"


@pytest.mark.parametrize(
    ("servos", "keys"),
    [
        ({"pan": {"id": 1}}, {}),
        ({"pan": {"id": 1}, "tilt": {"id": 3}}, {}),
        ({"pan": {"id": 1, "zero": 5}, "tilt": {"id": 2}}, {}),
        ({"pan": {"id": 1}, "tilt": {"id": 2}}, {"baudrate": 115200}),
        ({"pan": {"id": 1}, "tilt": {"id": 2}}, {"pad_check": "ignore"}),
    ],
)
def test_what_needs_the_line_to_be_opened_again_is_not_taken(servos: dict[str, Any], keys: dict[str, Any]) -> None:
    bench = enabled()
    assert not bench.driver.use_options(bus_options(servos, **keys))
    assert bench.driver.options == bus_options()


def test_a_latched_fault_does_not_keep_a_stop_back() -> None:
    bench = enabled()
    bench.driver.settings.aborts.faulty.add(1)
    assert bench.run(bench.driver.stop([target("pan")]))["pan"].confirmed


def test_disable_holds_the_servo_and_closes_the_gate() -> None:
    """KST RS422, 3, has no torque command."""
    bench = enabled(model=changed_model(max_steps_per_second=200.0))
    move(bench, pan=80)
    bench.after(0.5).frames()
    assert bench.run(bench.driver.disable("pan")) == StopReport("hold", True, True, HOLDS)
    assert bench.after(1).devices[0].goal == 105
    bench.frames()
    assert bench.run(bench.driver.disable("pan")).action == "none"
    assert bench.frames() == [read_frame(1)] * 2


def test_previews_are_the_frames_and_change_nothing() -> None:
    bench = Bench()
    goals = [goal("pan", 10), goal("tilt", -10)]
    assert [request.frame for request in bench.driver.preview_goals(goals)] == [position_frame(1, 100), position_frame(2, -100)]
    assert len(bench.driver.preview_stop([target("pan"), target("tilt")])) == 4
    travels = [servo.travel for servo in bench.driver.servos.values()]
    assert [(travel.last, travel.range, travel.jumped) for travel in travels] == [(None, None, False)] * 2
