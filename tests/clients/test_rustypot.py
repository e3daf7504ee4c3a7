"""rustypot, the robot makers' Rust client, against `servobus sim`: sync read, sync write, goal reached."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import pytest
import rustypot

from tests.clients.bus_process import served

pytestmark = pytest.mark.slow

STS3215 = 777
IDS = [1, 2, 3]
STANDING = [2048, 1000, 3000]
STEP = 2 * math.pi / 4096
READS = 2000
"""A servo arrives within so many reads."""
PATIENCE_S = 10.0


@pytest.fixture
def client(tmp_path: Path) -> Iterator[rustypot.Sts3215PyController]:
    with served(tmp_path) as path:
        yield rustypot.Sts3215PyController(path, 1_000_000, PATIENCE_S)


def test_it_finds_every_servo(client: rustypot.Sts3215PyController) -> None:
    """Ping, model number and a broadcast scan agree."""
    assert all(client.ping(node) for node in IDS)
    assert [client.read_register(node, "model") for node in IDS] == [STS3215] * 3
    assert client.broadcast_scan() == dict.fromkeys(IDS, STS3215)


def test_sync_read_has_every_position(client: rustypot.Sts3215PyController) -> None:
    """Positions are raw, and in radians from the middle."""
    assert client.sync_read_raw_present_position(IDS) == STANDING
    radians = [(raw - 2048) * STEP for raw in STANDING]
    assert client.sync_read_present_position(IDS) == pytest.approx(radians, abs=STEP / 2)


def test_sync_write_goals_are_reached(client: rustypot.Sts3215PyController) -> None:
    """Three goals in one frame are reached."""
    goals = [0.05, -1.55, 1.4]
    client.sync_write_torque_enable(IDS, [True] * 3)
    client.sync_write_goal_position(IDS, goals)
    near = pytest.approx(goals, abs=STEP)
    assert client.sync_read_goal_position(IDS) == near
    assert any(client.sync_read_present_position(IDS) == near for _ in range(READS))
    assert client.sync_read_moving(IDS) == [False] * 3


def test_registers_are_read_as_written(client: rustypot.Sts3215PyController) -> None:
    """A write reaches one servo and no other."""
    client.write_torque_enable(2, True)
    assert client.sync_read_torque_enable(IDS) == [False, True, False]
    client.write_torque_limit(2, 500)
    assert client.read_torque_limit(2) == [500]
    client.write_torque_enable(2, False)
    assert client.read_torque_enable(2) == [False]
