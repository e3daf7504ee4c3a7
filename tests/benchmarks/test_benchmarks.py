"""The benchmarks run, in one short round. Their figures are for `scripts/bench`, never asserted."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from tests.benchmarks import goals, responder, turns
from tests.benchmarks.report import Report, Row, Target

pytestmark = pytest.mark.slow

SECONDS = 0.05


@pytest.fixture(autouse=True)
def cores() -> Iterator[None]:
    before = os.sched_getaffinity(0)
    yield
    assert os.sched_getaffinity(0) == before


def test_turns() -> None:
    report = turns.main(SECONDS, 1)
    assert set(report.rows) >= set(turns.CLIENTS) - {"C loop"}
    assert all(row["turns/s"] and row["CPU us"] for row in report.rows.values())


def test_goals() -> None:
    report = goals.main(SECONDS, 1)
    assert all(row["calls/s"] and row["servos a frame"] for row in report.rows.values())


def test_the_responder_answers_like_a_servo() -> None:
    servos = responder.Responder()
    assert servos.receive(turns.READ_POSITION) == bytes.fromhex("ff ff 01 04 00 00 08 f2")
    assert servos.receive(goals.sync_write()[:20]) == b""
    assert servos.receive(goals.sync_write()[20:]) == b""
    assert (servos.frames, servos.servos) == (1, 12)
    assert servos.memory[12][goals.GOAL_POSITION : goals.GOAL_POSITION + goals.GOAL_SIZE] == goals.GOAL


def test_a_report_names_the_targets_that_were_missed() -> None:
    rows: dict[str, Row] = {"a": {"turns/s": 2.0}, "b": {"turns/s": None}}
    targets = [Target("a", "turns/s", minimum=3), Target("a", "turns/s", maximum=3), Target("b", "turns/s", minimum=1)]
    report = Report("title", rows, [*targets, Target("absent", "turns/s", minimum=1)])
    assert report.missed() == ["a: turns/s at least 3, measured 2"]
    assert report.as_json()["rows"] == rows
