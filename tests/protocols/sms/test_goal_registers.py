"""Which register values a goal becomes on the wire."""

from __future__ import annotations

import pytest

from servobus.errors import LimitError, NotSupported
from servobus.values import Goal, ServoGoal
from tests.protocols.sms.bench import Bench
from tests.protocols.sms.single_servo import changed

# Position, time and speed


@pytest.mark.parametrize(
    ("goal", "values"),
    [
        (Goal("position", 0), (2048, 0, 1000)),
        (Goal("position", 0, speed=90), (2048, 0, 1024)),
        (Goal("position", 0, speed=0.001), (2048, 0, 1)),
        (Goal("position", 45, duration=0.5), (2560, 0, 1024)),
        (Goal("position", 0, duration=0.5), (2048, 0, 1000)),
    ],
)
def test_position_time_and_speed(goal: Goal, values: tuple[int, int, int]) -> None:
    bench = Bench()
    bench.enable()
    bench.move({"a": goal})
    data = bench.sent[0].params[1:]
    assert tuple(int.from_bytes(data[at : at + 2], "little") for at in (0, 2, 4)) == values


@pytest.mark.parametrize("model", ["sts", "sms", "sms_cl"])
def test_a_speed_that_the_servo_cannot_be_told_is_refused(model: str) -> None:
    """FEETECH memory table, 18: while bit 2 is 0 a count is 50 steps/s. So 20 would be rest, or twice as fast."""
    for mode, goal in ((1, Goal("velocity", -20)), (0, Goal("position", 100, speed=20))):
        bench = Bench({"a": {"id": 1, "model": model, "unit": "step"}})
        for name, raw in (("phase", 8), ("mode", mode)):
            bench.devices[1].memory.store(bench.devices[1].memory.registers[name], raw)
        bench.enable()
        with pytest.raises(LimitError, match="slower than the servo can be told: its slowest is 50"):
            bench.move({"a": goal})
        assert not bench.sent
        bench.move({"a": Goal("velocity", 0) if mode else Goal("position", 100, duration=60)})
        bench.move({"a": Goal(goal.kind, 30, speed=None if mode else 30)})
        assert bench.register(1, "goal_speed") == 1


def test_an_scs_takes_a_time() -> None:
    bench = Bench({"s": {"id": 1, "model": "scs"}})
    bench.enable()
    bench.move({"s": Goal("position", 10, duration=1.5)})
    assert bench.sent[0].params.hex(" ") == "2a 02 2f 05 dc 00 00"
    bench.sent.clear()
    bench.move({"s": Goal("position", 10, speed=45)})
    assert bench.sent[0].params.hex(" ") == "2a 02 2f 00 01 00 d1", "the time word is 1 while speed rules: so a restart shows"


@pytest.mark.parametrize(
    ("speed", "raw"), [({"speed": 45}, 512), ({"max_speed": 90}, 1024), ({"speed": 45, "max_speed": 90}, 512), ({}, 1000)]
)
def test_whose_speed_counts(speed: dict[str, float], raw: int) -> None:
    bench = Bench({"a": {"id": 1, "model": "sts", **speed}})
    bench.enable()
    bench.move({"a": 10})
    assert int.from_bytes(bench.sent[0].params[5:7], "little") == raw


def test_speed_0_needs_allow_max_speed() -> None:
    bench = Bench()
    with pytest.raises(LimitError, match="allow_max_speed"):
        bench.driver.check_goal(ServoGoal("a", Goal("position", 0, speed=0)))
    free = Bench({"a": {"id": 1, "model": "sts", "allow_max_speed": True}})
    free.enable()
    free.move({"a": Goal("position", 0, speed=0)})
    assert free.sent[0].params[5:7] == b"\0\0"


def test_effort_and_acceleration_travel_with_the_goal() -> None:
    bench = Bench({"a": {"id": 1, "model": "sts", "acceleration": 500, "torque_limit": 50}})
    bench.enable()
    assert (bench.register(1, "acceleration"), bench.register(1, "torque_limit")) == (57, 500)
    bench.move({"a": Goal("position", 1, effort=20, acceleration=1000)})
    assert bench.sent[0].params[0] == 41
    assert (bench.register(1, "acceleration"), bench.register(1, "torque_limit")) == (114, 200)
    bench.move({"a": 2})
    assert (bench.register(1, "acceleration"), bench.register(1, "torque_limit")) == (57, 500), "the config's again"


@pytest.mark.parametrize(("position", "right"), [(2699.9, True), (2700.1, False), (-3059.9, True), (-3060.1, False)])
def test_the_limits_of_the_goal_register(position: float, right: bool) -> None:
    bench = Bench()
    goal = ServoGoal("a", Goal("position", position))
    if right:
        bench.driver.check_goal(goal)
    else:
        with pytest.raises(LimitError, match="goal_position"):
            bench.driver.check_goal(goal)


def test_an_scs_cannot_accelerate() -> None:
    bench = Bench({"s": {"id": 1, "model": "scs"}})
    with pytest.raises(NotSupported, match="no register for an acceleration"):
        bench.driver.check_goal(ServoGoal("s", Goal("position", 1, acceleration=5)))


def test_a_duration_needs_a_start() -> None:
    bench = Bench()
    with pytest.raises(LimitError, match="read the servo first"):
        bench.driver.plan_goals([ServoGoal("a", Goal("position", 1, duration=1))], together=False, confirm=False)


def test_no_flag_and_no_acknowledgement_means_no_confirm() -> None:
    bench = Bench(sts=changed("sts", async_write_flag=None), status_return="read_only")
    bench.enable()
    with pytest.raises(NotSupported, match="its REG WRITE flag cannot be read"):
        bench.move({"a": 1, "b": 1}, confirm=True)
    assert bench.sent == []


def test_a_model_without_a_mode_for_speeds_takes_positions_only() -> None:
    bench = Bench({"a": {"id": 1, "model": "scs"}})
    with pytest.raises(NotSupported, match="model scs takes position goals only"):
        bench.driver.check_goal(ServoGoal("a", Goal("velocity", 1)))


def test_a_wheels_acceleration_is_not_beside_its_speed() -> None:
    bench = Bench()
    device = bench.devices[1]
    device.memory.store(device.memory.registers["mode"], 1)
    bench.run(bench.driver.identify("a"))
    with pytest.raises(NotSupported, match="acceleration and goal_speed of model sts cannot be written in one frame"):
        bench.driver.check_goal(ServoGoal("a", Goal("velocity", 1, acceleration=100)))
