"""A servo that would move otherwise than it is asked to is not moved, and the refusal says what was read.

Families: FEETECH memory tables, addresses 2 to 4, and the vendor's headers SCSCL.h, SMS_STS.h, SMSBL.h, SMSCL.h. Modes: register
33 (35 in SMSCL.h), and both limits 0 in SCS (WritePWM of SCSCL.h).
"""

from __future__ import annotations

import re

import pytest

from servobus.errors import NotSupported
from servobus.protocols.sms.codec import Instruction
from servobus.values import Goal, Identity, ServoGoal
from tests.protocols.sms.bench import Bench
from tests.protocols.sms.states import FAMILIES, MODES, put, set_mode, travel

IDENTITIES = [
    # END, version at 3 and 4, family
    (0, 9, 3, "sts"),
    (0, 9, 2, "sts"),
    (0, 9, 99, "sts"),
    (0, 10, 1, "sts"),
    (0, 8, 44, "sms"),
    (0, 8, 0, "sms"),
    (0, 6, 3, "sms_cl"),
    (1, 5, 15, "scs"),
    (1, 5, 4, "scs"),
    (1, 9, 15, "scs"),
    (1, 9, 35, "scs"),
    (1, 9, 40, "scs"),
    (0, 10, 5, None),
    (0, 10, 0, None),
    (0, 5, 15, None),
    (0, 77, 1, None),
    (1, 9, 3, None),
    (1, 8, 44, None),
    (0, 0, 0, None),
]
STILL = {Instruction.READ}


def identity_of(bench: Bench) -> Identity:
    identity = bench.run(bench.driver.identify("a"))
    assert {packet.code for packet in bench.sent} <= STILL, "nothing is written"
    return identity


def refuses(bench: Bench, message: str) -> None:
    """Neither enable nor a goal is taken, both say why, and no write leaves."""
    bench.sent.clear()
    with pytest.raises(NotSupported, match=message):
        bench.run(bench.driver.enable("a"))
    for kind in ("position", "velocity"):
        with pytest.raises(NotSupported, match=message):
            bench.driver.check_goal(ServoGoal("a", Goal(kind, 1.0)))
    assert {packet.code for packet in bench.sent} <= STILL
    assert travel(bench, bench.devices[1]) == 0


# Families


@pytest.mark.parametrize("configured", FAMILIES)
@pytest.mark.parametrize(("end", "major", "minor", "family"), IDENTITIES)
def test_the_family_decides_and_another_one_is_not_moved(
    configured: str, end: int, major: int, minor: int, family: str | None
) -> None:
    bench = Bench({"a": {"id": 1, "model": configured}})
    bench.devices[1].pose_as(end, major, minor)
    identity = identity_of(bench)
    assert identity.model == family
    if family == configured:
        assert identity.obstacle == ""
        bench.enable()
        return
    assert identity.mode is None
    assert identity.obstacle in identity.notes
    if family is None:
        refuses(bench, f"no model knows it: it reports END {end} and version {major}/{minor} .* Give it a model file of its own")
    else:
        refuses(bench, rf"it reports .* \(model {family}\), the config says {configured}: set model: {family}")


@pytest.mark.parametrize(("end", "major", "minor", "family"), IDENTITIES)
def test_a_servo_that_is_not_configured_is_told_by_the_same_bytes(end: int, major: int, minor: int, family: str | None) -> None:
    bench = Bench()
    bench.devices[1].pose_as(end, major, minor)
    identity = bench.run(bench.driver.inspect(1))
    assert identity.model == family
    assert bool(identity.obstacle) is (family is None)


@pytest.mark.parametrize(
    ("end", "major", "minor", "product"),
    [(0, 10, 1, "HTS3235"), (0, 9, 11, "STS3250"), (0, 6, 0, "SMxx-360M"), (1, 5, 8, "SCS2332"), (1, 9, 35, "SCS-2 (9/35)")],
)
def test_the_product_is_named(end: int, major: int, minor: int, product: str) -> None:
    bench = Bench()
    bench.devices[1].pose_as(end, major, minor)
    assert bench.run(bench.driver.inspect(1)).product == product


# Modes


@pytest.mark.parametrize(("family", "mode"), MODES)
def test_only_the_modes_that_take_goals_are_enabled(family: str, mode: str) -> None:
    bench = Bench({"a": {"id": 1, "model": family}})
    set_mode(bench.devices[1], mode)
    identity = identity_of(bench)
    assert identity.mode == mode
    if mode in ("position", "velocity"):
        assert identity.obstacle == ""
        bench.enable()
        assert travel(bench, bench.devices[1]) == 0
    else:
        refuses(bench, f"it is in {mode} mode, which takes no position or velocity goals")


@pytest.mark.parametrize(("family", "mode"), [("sts", 4), ("sts", 255), ("sms", 4), ("sms_cl", 3)])
def test_a_mode_without_a_name_is_refused_by_its_number(family: str, mode: int) -> None:
    bench = Bench({"a": {"id": 1, "model": family}})
    bench.devices[1].memory.data[bench.devices[1].model.registers["mode"].address] = mode
    assert identity_of(bench).mode == f"mode {mode}"
    refuses(bench, f"it is in mode {mode} mode.*mode reads {mode}")


@pytest.mark.parametrize("family", FAMILIES)
def test_a_mode_that_was_changed_since_is_noticed_by_enable(family: str) -> None:
    bench = Bench({"a": {"id": 1, "model": family}})
    identity_of(bench)
    set_mode(bench.devices[1], "motor" if family == "scs" else "pwm")
    refuses(bench, "which takes no position or velocity goals")


@pytest.mark.parametrize("family", ["sts", "sms", "sms_cl"])
def test_a_goal_of_the_other_kind_is_refused(family: str) -> None:
    bench = Bench({"a": {"id": 1, "model": family}})
    for mode, kind in (("position", "velocity"), ("velocity", "position")):
        set_mode(bench.devices[1], mode)
        identity_of(bench)
        with pytest.raises(NotSupported, match=f"is in {mode} mode and cannot take a {kind} goal"):
            bench.driver.check_goal(ServoGoal("a", Goal(kind, 1.0)))  # type: ignore[arg-type]


# Limits and units


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("limits", [(700, 300), (500, 500)])
def test_limits_in_the_wrong_order_are_refused(family: str, limits: tuple[int, int]) -> None:
    bench = Bench({"a": {"id": 1, "model": family}})
    put(bench.devices[1], "min_angle_limit", limits[0])
    put(bench.devices[1], "max_angle_limit", limits[1])
    identity_of(bench)
    refuses(bench, f"in the wrong order .min_angle_limit {limits[0]}, max_angle_limit {limits[1]}")


@pytest.mark.parametrize("family", ["sts", "sms"])
def test_another_size_of_a_step_is_refused(family: str) -> None:
    bench = Bench({"a": {"id": 1, "model": family}})
    put(bench.devices[1], "angle_resolution", 3)
    identity_of(bench)
    refuses(bench, "angle_resolution reads 3")


@pytest.mark.parametrize("family", FAMILIES)
def test_one_altered_reading_of_the_settings_is_not_believed(family: str) -> None:
    """An altered mode, limit or unit whose checksum is right."""
    bench = Bench({"a": {"id": 1, "model": family}})
    device = bench.devices[1]
    right, altered = bytes(device.memory.data), [1]

    def once(packet: object) -> bool:
        device.memory.data[:16] = right[:16]
        if altered and altered.pop():
            device.memory.data[9:13] = bytes(4)
        return False

    bench.is_lost = once
    identity = bench.run(bench.driver.identify("a"))
    assert identity.mode == "position"
    assert identity.limits is not None


# What a register written by hand changes


@pytest.mark.parametrize("family", ["sts", "sms", "sms_cl"])
def test_a_mode_written_by_hand_counts_at_once(family: str) -> None:
    bench = Bench({"a": {"id": 1, "model": family}})
    identity_of(bench)
    bench.run(bench.driver.write_register("a", "mode", 1, persist=True))
    bench.driver.check_goal(ServoGoal("a", Goal("velocity", 1.0)))
    with pytest.raises(NotSupported, match=re.escape("velocity mode")):
        bench.driver.check_goal(ServoGoal("a", Goal("position", 1.0)))


@pytest.mark.parametrize(
    ("end", "major", "minor", "family"), [(0, 9, 3, "sts"), (0, 8, 44, "sms"), (1, 5, 15, "scs"), (0, 10, 5, None)]
)
@pytest.mark.parametrize("configured", FAMILIES)
def test_no_register_is_written_by_name_where_another_table_is(
    configured: str, end: int, major: int, minor: int, family: str | None
) -> None:
    """The name would mean another register: the lock of SCS (48) is the torque limit of STS."""
    bench = Bench({"a": {"id": 1, "model": configured}})
    bench.devices[1].pose_as(end, major, minor)
    identity_of(bench)
    bench.sent.clear()
    plan = bench.driver.write_register("a", "min_angle_limit", 10.0, persist=True)
    if configured == family:
        bench.run(plan)
        return
    with pytest.raises(NotSupported, match="is not written: "):
        bench.run(plan)
    assert not bench.sent


# Another product


@pytest.mark.parametrize(("number", "degrees"), [((5, 15), 220), ((5, 4), 300)])
@pytest.mark.parametrize("direction", [1, -1])
def test_a_product_moves_at_its_own_scale_and_not_at_that_of_its_family(
    number: tuple[int, int], degrees: int, direction: int
) -> None:
    """1024 steps are 300 degrees of an SCS0009 (its data sheet; rustypot), and 220 of an SCS15."""
    bench = Bench({"a": {"id": 1, "model": "scs", "direction": direction, "speed": 30}})
    bench.devices[1].pose_as(1, *number)
    before = bench.ask(bench.driver.read_register("a", "present_position"))
    assert before == 0
    bench.enable()
    steps = round(direction * 45 * 1024 / degrees)
    bench.move({"a": 45})
    assert bench.register(1, "goal_position") == 512 + steps
    assert bench.register(1, "goal_speed") == round(30 * 1024 / degrees)
    bench.now += 10
    state = bench.ask(bench.driver.read_state("a"))["a"]
    assert state["position"] == pytest.approx(45, abs=0.3)
    assert bench.ask(bench.driver.read_register("a", "present_position")) == pytest.approx(45, abs=0.3)
    low, high = bench.driver.servos["a"].limits or (0, 0)
    assert high - low == pytest.approx(degrees * 983 / 1024), "limits 20 to 1003"


def test_units_of_a_model_file_of_the_user_count_more_than_those_of_the_product() -> None:
    bench = Bench({"a": {"id": 1, "model": "scs"}})
    servo = bench.driver.servos["a"]
    servo.model = servo.model.model_copy(update={"units": {"deg": 0.5}})
    bench.devices[1].pose_as(1, 5, 4)
    bench.enable()
    bench.move({"a": 45})
    assert bench.register(1, "goal_position") == 512 + 90
