"""What is remembered of a servo between two turns."""

from __future__ import annotations

import pytest

from servobus import values
from servobus.bus.records import ServoRecord
from servobus.engine.health import Health
from servobus.protocols.options import ServoOptions
from servobus.values import State


@pytest.fixture
def record() -> ServoRecord:
    health = Health((1,), changed=lambda node, before: None)
    return ServoRecord("elbow", ServoOptions(id=1), health.node(1))


def test_of_a_servo_nobody_heard_nothing_is_known(record: ServoRecord) -> None:
    assert record.state(5.0, ()) == State(health=values.Health.DOUBTFUL)
    assert record.reference() is None
    assert record.position(5.0, 1e9) is None


def test_fields_stay_until_newer_ones_come_and_the_age_is_that_of_the_newest(record: ServoRecord) -> None:
    record.update({"position": 1.0, "voltage": 12.0}, 10.0)
    record.update({"position": 2.0}, 11.0)
    state = record.state(11.5, ("overheat",))
    assert (state.position, state.voltage, state.time, state.age) == (2.0, 12.0, 11.0, 0.5)
    assert state.faults == ("overheat",)


def test_a_position_is_fresh_up_to_its_age(record: ServoRecord) -> None:
    record.update({"position": 7.0}, 10.0)
    record.update({"voltage": 12.0}, 20.0)
    assert record.position(10.25, 0.25) == 7.0
    assert record.position(10.26, 0.25) is None, "another field does not make it fresh"


def test_a_step_counts_from_the_setpoint_else_from_the_position(record: ServoRecord) -> None:
    record.update({"position": 7.0}, 10.0)
    assert record.reference() == 7.0
    record.setpoint = 0.0
    assert record.reference() == 0.0


def test_the_goal_is_our_setpoint_else_what_the_servo_says(record: ServoRecord) -> None:
    record.update({"goal": 3.0}, 10.0)
    assert record.state(10.0, ()).goal == 3.0
    record.setpoint = 0.0
    assert record.state(10.0, ()).goal == 0.0


def test_the_status_is_that_of_the_last_reply_else_what_was_read(record: ServoRecord) -> None:
    record.update({"status": 4}, 10.0)
    assert record.state(10.0, ()).status == 4
    record.node.answered(0)
    assert record.state(11.0, ()).status == 0


def test_enabled_and_health_are_our_own_knowledge(record: ServoRecord) -> None:
    record.enabled = True
    record.node.recovered()
    state = record.state(0.0, ())
    assert (state.enabled, state.health) == (True, "online")
