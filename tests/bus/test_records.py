"""What the record of a servo keeps between two turns."""

from __future__ import annotations

import pytest

from servobus.bus.records import ServoRecord
from servobus.engine.health import NodeTable
from servobus.protocols.options import ServoOptions
from servobus.values import Health, State


@pytest.fixture
def record() -> ServoRecord:
    nodes = NodeTable((1,), changed=lambda node, before: None)
    return ServoRecord("elbow", ServoOptions(id=1), nodes.node(1))


def test_a_servo_that_never_replied_has_an_empty_state(record: ServoRecord) -> None:
    assert record.state(5.0, ()) == State(health=Health.DOUBTFUL)
    assert record.reference() is None
    assert record.position(5.0, 1e9) is None


def test_a_field_stays_until_a_newer_one_comes_and_age_is_that_of_the_newest(record: ServoRecord) -> None:
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


def test_a_step_counts_from_the_goal_else_from_the_position(record: ServoRecord) -> None:
    record.update({"position": 7.0}, 10.0)
    assert record.reference() == 7.0
    record.goal = 0.0
    assert record.reference() == 0.0


def test_the_goal_is_ours_else_the_one_that_the_servo_reports(record: ServoRecord) -> None:
    record.update({"goal": 3.0}, 10.0)
    assert record.state(10.0, ()).goal == 3.0
    record.goal = 0.0
    assert record.state(10.0, ()).goal == 0.0


def test_the_status_is_that_of_the_last_reply_else_what_was_read(record: ServoRecord) -> None:
    record.update({"status": 4}, 10.0)
    assert record.state(10.0, ()).status == 4
    record.node.answered(0)
    assert record.state(11.0, ()).status == 0


def test_enabled_and_health_are_kept_by_the_host(record: ServoRecord) -> None:
    record.enabled = True
    record.node.fenced()
    state = record.state(0.0, ())
    assert (state.enabled, state.health) == (True, "online")
