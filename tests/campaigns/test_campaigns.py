"""The long campaigns, short and seeded: the same rules, fewer turns. Their figures are for `scripts/soak`, never asserted."""

from __future__ import annotations

from typing import Literal

import pytest

from tests.campaigns import days, dead_servo, estop, faults, slow_hand
from tests.campaigns.faults import KINDS, Result
from tests.campaigns.oracle import ORACLES

pytestmark = pytest.mark.slow


def assert_right(result: Result) -> None:
    assert (result.wrong, result.hung, result.leaked, result.waiting) == (0, 0, 0, 0)


@pytest.mark.parametrize(("protocol", "seed"), [("sms", 1), ("sms", 2), ("kst", 1), ("kst", 2), ("roh", 1), ("roh", 2)])
def test_faults(protocol: str, seed: int) -> None:
    result = faults.faults(20_000, protocol=protocol, seed=seed)
    assert_right(result)
    assert result.reads > 19_000
    assert result.counts["timeouts"] > 100, "the line was as bad as it should be"


@pytest.mark.parametrize("chop", ["bytes", "random"])
def test_faults_in_pieces(chop: Literal["bytes", "random"]) -> None:
    assert_right(faults.faults(3000, chop=chop))


@pytest.mark.parametrize("protocol", ORACLES)
def test_a_very_bad_line_is_slow_and_right(protocol: str) -> None:
    result = faults.faults(3000, protocol=protocol, share=0.2)
    assert_right(result)
    assert result.timeouts > 0


@pytest.mark.parametrize("protocol", ORACLES)
def test_cancelled_callers(protocol: str) -> None:
    result = faults.cancel(3000, protocol=protocol)
    assert_right(result)
    assert result.cancelled >= 3000
    assert result.reads > 1000


def test_every_kind_of_fault_is_in() -> None:
    damage = faults.options(0.01).model_dump()
    assert all(damage[kind] > 0 for kind in KINDS)
    assert sum(damage[kind] for kind in KINDS) == pytest.approx(0.01)


def test_a_dead_servo_and_a_pulled_plug() -> None:
    figures = dead_servo.main(0.2)
    assert figures.rate_with_dead > 0
    assert figures.unplug_errors == dead_servo.SERVOS - 1
    assert figures.replug > 0


def test_a_hand_slower_than_the_deadline() -> None:
    result = slow_hand.slow_hand(1000)
    assert_right(result)
    assert result.reads > 200
    assert result.timeouts > 50


def test_half_a_minute_of_the_days() -> None:
    result = days.days(0.01)
    assert not any(result.balance().values())
    assert result.drift < days.MAX_DRIFT
    assert result.counts["timeouts"] > 50, "the line was as bad as it should be"
    assert result.outcomes["sent"] > 4000


@pytest.mark.parametrize("real", [True, False], ids=["real", "virtual"])
@pytest.mark.parametrize("setting", estop.SETTINGS, ids=lambda setting: setting.name)
def test_estops_are_confirmed(setting: estop.Setting, real: bool) -> None:
    latency = estop.estop(setting, 3, real=real)
    assert latency.unconfirmed == 0
    assert len(latency.frames) == 3
    assert all(0 < frame <= answer for frame, answer in zip(latency.frames, latency.answers, strict=True))
