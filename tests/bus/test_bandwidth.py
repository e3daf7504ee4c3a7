"""What a config asks of its line, counted by hand."""

from __future__ import annotations

import pytest

from servobus.bus.bandwidth import TURNAROUND, line_bandwidth
from servobus.protocols.base import LineTraits
from servobus.protocols.registry import PROTOCOLS
from tests.simulated_rigs import config

BYTE = 10 / 115200


def load_of(*servos: str, latency: float = 0.0, **keys: str):  # type: ignore[no-untyped-def]
    options_of = config(*servos, **{"baudrate": "115200", **keys})
    options, models = options_of.buses["arm"], options_of.models["arm"]
    return line_bandwidth(options, PROTOCOLS["sms"].driver(options, models), LineTraits(options.baudrate, latency=latency))


def test_goals_of_several_servos_are_one_sync_write() -> None:
    load = load_of("a: {id: 1, model: sts}", "b: {id: 2, model: sts}", goal_rate="100")
    frame = 8 + 2 * (6 + 1)
    assert load.shares == {"goals": pytest.approx(100 * 100 * frame * BYTE)}
    assert load.total == load.shares["goals"]


def test_the_goal_of_one_servo_is_an_answered_write() -> None:
    load = load_of("a: {id: 1, model: sts, limits: [90, 100]}", goal_rate="100")
    turn = (13 + 6) * BYTE + TURNAROUND
    assert load.shares["goals"] == pytest.approx(100 * 100 * turn)
    assert load.goal_latency == pytest.approx(3 * turn)


def test_polls_count_question_pause_and_answer() -> None:
    sms = "a: {id: 1, model: sms}"
    load = load_of(sms, poll="{feedback: 50, health: 2}")
    read = 8 * BYTE + TURNAROUND
    assert load.shares["feedback"] == pytest.approx(100 * 50 * (read + (6 + 27) * BYTE))
    assert load.shares["health"] == pytest.approx(100 * 2 * (read + (6 + 31) * BYTE))
    assert load.shares["goals"] > 0, "goals are counted at the feedback rate"


def test_latencies() -> None:
    load = load_of("a: {id: 1, model: sms}", poll="{health: 1}", latency=0.002, timeout_ms="10")
    longest = 8 * BYTE + TURNAROUND + (6 + 31) * BYTE
    stop = 8 * BYTE + TURNAROUND + (6 + 34) * BYTE + 2 * 11 * BYTE  # mode to moving are read, then the goal twice
    assert load.estop_latency == pytest.approx(longest + stop + 0.002)
    assert load.silent_latency == pytest.approx(0.010 + 0.002)


def test_a_line_without_servos_asks_nothing() -> None:
    options = config().buses["arm"].model_copy(update={"servos": {}})
    load = line_bandwidth(options, PROTOCOLS["sms"].driver(options, {}), LineTraits(options.baudrate))
    assert (load.total, load.goal_latency, load.estop_latency) == (0, 0, 0)
