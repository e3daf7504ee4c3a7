"""One configured servo: its units, its goals as bytes, and what its blocks of registers mean."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobus.errors import LimitError, NotSupported
from servobus.protocols.sms.model import SmsModel
from servobus.protocols.sms.options import SmsServo
from servobus.protocols.sms.packer import GoalPacker
from servobus.protocols.sms.servo import Fit, HostServo
from servobus.values import Goal, ServoGoal
from tests.protocols.sms.single_servo import FAMILIES, model_of

STEP = 360 / 4096


def servo_of(family: str = "sts", model: SmsModel | None = None, **keys: Any) -> HostServo:
    servo = HostServo("a", SmsServo(id=1, model=family, **keys), model or model_of(family))
    servo.hold(GoalPacker(servo).settings(None, None))  # as enable() leaves it
    return servo


def span_of(servo: HostServo, goal: Goal, start: float | None = None) -> str:
    packed = GoalPacker(servo).pack(ServoGoal("a", goal, start))
    return f"{packed.address:02x} {packed.data.hex(' ')}"


# Units


@pytest.mark.parametrize(
    ("name", "raw", "value"),
    [
        ("present_position", 2048, 0.0),
        ("present_position", 3072, 90.0),
        ("min_angle_limit", 1024, -90.0),
        ("present_speed", -1024, -90.0),
        ("goal_speed", 1000, 1000 * STEP),
        ("acceleration", 10, 1000 * STEP),
        ("present_voltage", 74, 7.4),
        ("present_load", -500, -50.0),
        ("baud_rate", 4, 115_200),
        ("id", 7, 7),
    ],
)
def test_registers_in_the_servos_unit(name: str, raw: int, value: float) -> None:
    servo = servo_of()
    register = servo.model.registers[name]
    assert servo.to_physical(register, raw) == pytest.approx(value)
    assert servo.to_raw(register, value) == raw


def test_another_direction_zero_gear_and_unit() -> None:
    servo = servo_of(zero=1000, direction=-1, gear=2, unit="step")
    register = servo.model.registers["present_position"]
    assert servo.to_physical(register, 1010) == -5.0
    assert servo.to_raw(register, -5.0) == 1010
    assert servo.to_physical(servo.model.registers["present_speed"], 10) == -5.0
    assert servo.to_physical(servo.model.registers["acceleration"], 1) == 50, "an acceleration has no direction"


@pytest.mark.parametrize("family", FAMILIES)
def test_the_middle_is_position_0(family: str) -> None:
    servo = servo_of(family)
    assert servo.to_physical(servo.model.registers["present_position"], servo.model.zero) == 0.0
    assert servo.model.zero == (512 if family == "scs" else 2048)


@pytest.mark.parametrize("name", ["goal_position", "goal_speed", "acceleration", "torque_limit"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), True, "1", None, 10**400], ids=lambda value: str(value)[:5])
def test_values_that_are_not_numbers_are_refused(name: str, value: Any) -> None:
    servo = servo_of()
    with pytest.raises(LimitError, match=f"register {name}: .* is not a finite number"):
        servo.to_raw(servo.model.registers[name], value)


@given(st.integers(-32767, 32767))
def test_positions_there_and_back(raw: int) -> None:
    servo = servo_of(zero=1707, direction=-1)
    register = servo.model.registers["goal_position"]
    assert servo.to_raw(register, servo.to_physical(register, raw)) == raw
    assert servo.decode(register, servo.encode(register, raw)) == raw


def test_a_value_the_register_cannot_hold_names_the_servo() -> None:
    servo = servo_of()
    with pytest.raises(LimitError, match=r"^a: register goal_position: raw value 32768 is outside -32767 to 32767"):
        servo.encode(servo.model.registers["goal_position"], 32768)


# Blocks


def test_a_block_becomes_fields_of_the_state() -> None:
    commands = "01 fe 00 08 00 00 e8 03 e8 03 00 00 00 00 00 01"
    data = bytes.fromhex(commands + "00 0c 00 84 f4 05 4a 1e 00 20 01 00 08 64 00")
    assert servo_of().decode_state(data) == {
        "position": 90.0,
        "speed": -90.0,
        "load": -50.0,
        "voltage": 7.4,
        "temperature": 30,
        "status": 0x20,
        "moving": True,
        "goal": 0.0,
        "current": 0.65,
        "energised": True,
        "loss": None,
    }
    feedback = servo_of().decode_feedback(data[:27])
    assert set(feedback) == {"position", "speed", "load", "voltage", "temperature", "status", "moving", "energised", "loss"}
    assert feedback["moving"] is True


def test_an_scs_sends_the_high_byte_first() -> None:
    commands = "01 00 02 00 00 01 03 e8 01 00 00 00 00 00 00 00"
    update = servo_of("scs").decode_feedback(bytes.fromhex(commands + "02 01 80 0a 04 64 4a 1e 00 00 00"))
    assert (update["position"], update["speed"]) == pytest.approx((0.21484375, -10 * 0.21484375))
    assert (update["load"], update["moving"]) == (-10.0, False)


# Goals


@pytest.mark.parametrize(
    ("family", "goal", "span"),
    [
        ("sts", Goal("position", 0), "2a 00 08 00 00 e8 03"),
        ("sms", Goal("position", 0), "2a 00 08 00 00 e8 03"),
        ("sms_cl", Goal("position", 0), "2a 00 08 00 00 e8 03"),
        ("scs", Goal("position", 0), "2a 02 00 00 01 03 e8"),
        ("sts", Goal("position", -180 - STEP), "2a 01 80 00 00 e8 03"),
        ("sts", Goal("position", 0, acceleration=1000 * STEP), "29 0a 00 08 00 00 e8 03"),
        ("sts", Goal("position", 0, effort=50), "2a 00 08 00 00 e8 03 f4 01"),
        ("sts", Goal("position", 0, acceleration=1000 * STEP, effort=100), "29 0a 00 08 00 00 e8 03 e8 03"),
    ],
)
def test_goals_as_bytes(family: str, goal: Goal, span: str) -> None:
    assert span_of(servo_of(family), goal) == span


def test_an_acceleration_below_one_count_is_one() -> None:
    """0 would be no limit at all."""
    assert span_of(servo_of(), Goal("position", 0, acceleration=0.001)) == "29 01 00 08 00 00 e8 03"


@pytest.mark.parametrize(
    ("goal", "right"),
    [
        (Goal("position", 0, acceleration=25_449 * STEP), True),
        (Goal("position", 0, acceleration=25_451 * STEP), False),
        (Goal("position", 0, speed=32_767.4 * STEP), True),
        (Goal("position", 0, speed=32_767.6 * STEP), False),
        (Goal("position", 0, effort=100.04), True),
        (Goal("position", 0, effort=100.06), False),
    ],
)
def test_goals_at_the_edge_of_their_registers(goal: Goal, right: bool) -> None:
    if right:
        assert span_of(servo_of(), goal)
    else:
        with pytest.raises(LimitError, match="is outside"):
            span_of(servo_of(), goal)


@pytest.mark.parametrize(("duration", "right"), [(9.9994, True), (9.9996, False), (0.0001, True)])
def test_the_time_register_of_an_scs(duration: float, right: bool) -> None:
    goal = Goal("position", 0, duration=duration)
    if right:
        time = span_of(servo_of("scs"), goal).split()[3:5]
        assert int("".join(time), 16) == max(1, round(1000 * duration))
    else:
        with pytest.raises(LimitError, match="goal_time"):
            span_of(servo_of("scs"), goal)


@pytest.mark.parametrize(
    ("value", "duration", "start", "speed"),
    [(90, 1.0, 0.0, 1024), (-90, 1.0, 0.0, 1024), (90, 1.0, 90.0, 1000), (90, 1.0, 89.9999, 1), (90, 2.0, -90.0, 1024)],
)
def test_a_duration_becomes_a_speed(value: float, duration: float, start: float, speed: int) -> None:
    data = span_of(servo_of(), Goal("position", value, duration=duration), start).split()
    assert int(data[6] + data[5], 16) == speed


@pytest.mark.parametrize("direction", [1, -1])
def test_velocities_have_a_sign_and_speeds_have_none(direction: int) -> None:
    servo = servo_of(direction=direction)
    assert span_of(servo, Goal("position", 0, speed=90)).endswith("00 04")
    servo.learn(Fit("velocity"))
    assert span_of(servo, Goal("velocity", 90)) == ("2e 00 04" if direction == 1 else "2e 00 84")
    assert span_of(servo, Goal("velocity", 0)) == "2e 00 00"


def test_a_wheel_takes_an_effort_beside_its_speed() -> None:
    servo = servo_of()
    servo.learn(Fit("velocity"))
    assert span_of(servo, Goal("velocity", 90, effort=50)) == "2e 00 04 f4 01"


@pytest.mark.parametrize(("mode", "kind"), [("position", "velocity"), ("velocity", "position")])
def test_a_goal_of_the_other_kind(mode: Any, kind: Any) -> None:
    servo = servo_of()
    servo.learn(Fit(mode))
    with pytest.raises(NotSupported, match=f"is in {mode} mode and cannot take a {kind} goal: change its mode registers"):
        span_of(servo, Goal(kind, 0))


@pytest.mark.parametrize(
    ("family", "goal", "what"),
    [
        ("scs", Goal("position", 0, effort=5), "a torque limit"),
        ("sms_cl", Goal("position", 0, effort=5), "a torque limit"),
        ("scs", Goal("position", 0, acceleration=5), "an acceleration"),
    ],
)
def test_a_setting_without_a_register_is_refused(family: str, goal: Goal, what: str) -> None:
    with pytest.raises(NotSupported, match=f"model {family} has no register for {what}: take it out"):
        span_of(servo_of(family), goal)


def test_only_missing_settings_travel_with_a_goal() -> None:
    servo = servo_of()
    packer = GoalPacker(servo)
    assert packer.missing_settings(Goal("position", 0)) == {}
    servo.hold({"acceleration": 7})
    assert packer.missing_settings(Goal("position", 0)) == {"acceleration": 254}
    servo.held = {}
    assert span_of(servo, Goal("position", 0)) == "29 fe 00 08 00 00 e8 03", "what is not known is written"


def test_the_configs_acceleration_and_torque_limit() -> None:
    servo = servo_of(acceleration=1000 * STEP, torque_limit=60)
    assert servo.held == {"acceleration": 10, "torque_limit": 600}
    assert span_of(servo, Goal("position", 0)) == "2a 00 08 00 00 e8 03"
    assert span_of(servo, Goal("position", 0, effort=50)) == "2a 00 08 00 00 e8 03 f4 01"
