"""Counters and histograms: how exact their figures are."""

from __future__ import annotations

import random

import pytest

from servobus.engine.stats import SUB_BUCKETS, BusStats, Counter, Histogram


def histogram(*durations: float) -> Histogram:
    made = Histogram()
    for each in durations:
        made.add(each)
    return made


def test_an_empty_histogram_has_only_zeros() -> None:
    empty = Histogram()
    assert (empty.percentile(0.5), empty.max, empty.count, list(empty.buckets())) == (0.0, 0.0, 0, [])


@pytest.mark.parametrize("exponent", range(1, 38))
@pytest.mark.parametrize("offset", [-1, 0, 1])
def test_a_bucket_is_no_more_than_an_eighth_wider_than_its_duration(exponent: int, offset: int) -> None:
    microseconds = 2**exponent + offset
    ((upper, count),) = histogram((microseconds + 0.5) / 1e6).buckets()
    assert count == 1
    assert microseconds < upper * 1e6 <= max(microseconds * (1 + 1 / SUB_BUCKETS), microseconds + 1) * (1 + 1e-12)


def test_percentiles_are_true_to_within_an_eighth() -> None:
    rng = random.Random(5)
    durations = sorted(rng.lognormvariate(-6, 2) for _ in range(2000))
    made = histogram(*durations)
    for share in (0.01, 0.25, 0.5, 0.9, 0.99, 1.0):
        true = durations[max(0, round(share * len(durations)) - 1)]
        assert true <= made.percentile(share) + 1e-6
        assert made.percentile(share) <= true * (1 + 1 / SUB_BUCKETS) + 1e-6


def test_the_maximum_is_exact_and_no_percentile_is_above_it() -> None:
    made = histogram(0.001, 0.00103)
    assert made.max == made.percentile(1.0) == 0.00103
    assert made.total == pytest.approx(0.00203)


def test_the_lowest_percentile_is_the_smallest_and_the_buckets_ascend() -> None:
    made = histogram(0.5, 0.000003, 0.02, 0.02)
    assert made.percentile(0.0) == pytest.approx(0.000004)
    uppers = [upper for upper, _ in made.buckets()]
    assert uppers == sorted(uppers)
    assert sum(count for _, count in made.buckets()) == made.count == 4


def test_it_is_bounded_whatever_it_is_fed() -> None:
    made = histogram(-1.0, 0.0, 1e12)
    assert made.count == 3
    assert made.percentile(0.5) == pytest.approx(1e-6)
    assert made.max == 1e12
    assert made.percentile(1.0) < 1e12, "beyond the last bucket only `max` is exact"


def test_a_snapshot_is_made_of_plain_numbers_and_has_every_counter() -> None:
    stats = BusStats(10.0)
    stats.counts[Counter.TURNS] += 2
    stats.turns.add(0.002)
    stats.busy = 0.25
    assert stats.snapshot(11.0, {Counter.DRAINS: 3}) == {
        **{counter.value: 0 for counter in Counter},
        "turns": 2,
        "drains": 3,
        "wire_load_percent": 25.0,
        "turn_ms": {"p50": 2.0, "p99": 2.0, "max": 2.0},
    }


def test_a_snapshot_of_the_first_moment_has_no_load() -> None:
    stats = BusStats(10.0)
    stats.busy = 1.0
    assert stats.snapshot(10.0)["wire_load_percent"] == 0.0
