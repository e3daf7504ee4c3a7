"""What a client keeps, given the time."""

from __future__ import annotations

import asyncio

import pytest

from servobus.errors import LinkDown
from servobus.remote.cache import LatestSnapshot, StateCache, received
from servobus.values import Health, State

NAMES = {"arm/a": ("arm", "a"), "arm/b": ("arm", "b")}


def test_times_are_of_this_machine() -> None:
    assert received(State(time=5.0, age=0.25), 100.0) == State(time=99.75, age=0.25)
    assert received(State(), 100.0) == State()
    assert received(State(time=5.0), 100.0) == State()


def test_a_snapshot_has_every_name_and_the_age_of_the_moment() -> None:
    cache = StateCache()
    cache.names = NAMES
    cache.put({"arm/b": State(position=1.0, time=99.0, age=0.1, health=Health.ONLINE), "arm/gone": State()})
    assert cache.snapshot(102.0) == {"arm/a": State(), "arm/b": State(position=1.0, time=99.0, age=3.0, health=Health.ONLINE)}
    cache.put({"arm/b": State(position=2.0, time=103.0)})
    assert cache.snapshot(102.0)["arm/b"] == State(position=2.0, time=103.0, age=0.0)


def test_without_a_daemon_all_is_offline_without_figures() -> None:
    cache = StateCache()
    cache.names = NAMES
    cache.put({"arm/b": State(position=1.0, time=99.0, health=Health.ONLINE)})
    cache.put_stats({"arm": {}})
    assert cache.stats() == {"arm": {}}
    cache.down = LinkDown("away")
    assert [state.health for state in cache.snapshot(100.0).values()] == ["offline", "offline"]
    with pytest.raises(LinkDown, match="away"):
        cache.stats()


async def test_the_newest_replaces_what_was_not_fetched() -> None:
    newest = LatestSnapshot()
    waiting = asyncio.create_task(newest.get())
    await asyncio.sleep(0)
    newest.put({"a": State(position=1.0)})
    assert (await waiting)["a"].position == 1.0
    newest.put({"a": State(position=2.0)})
    newest.put({"a": State(position=3.0)})
    assert (await newest.get())["a"].position == 3.0
