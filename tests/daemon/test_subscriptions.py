"""Subscriptions at their rate, and an end to what one client may ask for."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

from servobus.daemon.connection import MAX_WAITING
from servobus.rpc.methods import MAX_SUBSCRIPTIONS
from tests.daemon.raw_client import dialled, served
from tests.simulated_rigs import config, devices
from tests.virtual_time import virtual

# Subscriptions


@virtual
async def test_states_come_at_their_rate_and_only_what_was_asked_for(tmp_path: Path) -> None:
    async with served(tmp_path, config(poll="{feedback: 50}")) as (_, _, path), dialled(path) as raw:
        number = await raw.call("subscribe", topic="state", hz=10, names=["s1"], fields=["position", "health"])
        await asyncio.sleep(2)
        assert await raw.call("unsubscribe", subscription=number) is None
        notices = [note["params"] for note in raw.notices]
        assert 18 <= len(notices) <= 22
        assert notices[0] == {
            "subscription": number,
            "missed": 0,
            "stopped": False,
            "states": {"arm/s1": {"position": 0.0, "health": "online"}},
        }
        assert (await raw.call("unsubscribe", subscription=number))["type"] == "UnknownName"


@pytest.mark.parametrize(
    ("params", "error"),
    [
        ({"topic": "weather"}, "NotSupported"),
        ({"topic": "state", "hz": 0}, "NotSupported"),
        ({"topic": "state", "hz": 201}, "NotSupported"),
        ({"topic": "state", "names": ["nobody"]}, "UnknownName"),
        ({"topic": "state", "fields": ["colour"]}, "UnknownName"),
    ],
)
@virtual
async def test_subscriptions_that_cannot_be(params: dict[str, Any], error: str, tmp_path: Path) -> None:
    async with served(tmp_path) as (_, _, path), dialled(path) as raw:
        assert (await raw.call("subscribe", **params))["type"] == error


@virtual
async def test_there_is_an_end_to_subscriptions(tmp_path: Path) -> None:
    async with served(tmp_path) as (_, _, path), dialled(path) as raw:
        for _ in range(MAX_SUBSCRIPTIONS):
            await raw.call("subscribe", topic="events")
        assert (await raw.call("subscribe", topic="events"))["type"] == "Overloaded"


@virtual
async def test_a_client_that_does_not_read_sees_what_it_missed(tmp_path: Path) -> None:
    async with served(tmp_path) as (_, door, path):
        async with dialled(path) as raw:
            for _ in range(8):
                await raw.call("subscribe", topic="state", hz=200)
            (client,) = door.connections
            while not client.blocked:  # noqa: ASYNC110 - there is no event to wait for
                await asyncio.sleep(0.1)
            missed = [sub.missed for sub in door.subscriptions._of[client].values()]
            await asyncio.sleep(1)
            assert [sub.missed for sub in door.subscriptions._of[client].values()] > missed
            await asyncio.sleep(11)
        assert not door.connections


@virtual
async def test_one_above_his_rate_is_read_more_slowly_and_loses_nothing(tmp_path: Path) -> None:
    async with served(tmp_path, rate=20) as (_, _, path), dialled(path) as raw:
        began = asyncio.get_running_loop().time()
        numbers = [raw.ask("stopped") for _ in range(60)]
        assert [(await raw.line())["id"] for _ in numbers] == numbers
        assert asyncio.get_running_loop().time() - began == pytest.approx(2, abs=0.2), "20 at once, then 20 a second"


@virtual
async def test_waiting_calls_are_bounded_and_none_is_lost(tmp_path: Path) -> None:
    async with served(tmp_path, rate=1000) as (_, door, path), dialled(path) as raw:
        numbers = [raw.ask("read", name="s1", max_age=3600) for _ in range(8000)]
        waiting = 0
        for number in numbers:
            assert (await raw.line())["id"] == number
            waiting = max(waiting, next(iter(door.connections))._waiting)
        assert MAX_WAITING / 2 < waiting < 3 * MAX_WAITING, "one more piece of the socket may be read before it rests"
        assert not next(iter(door.connections))._waiting


@virtual
async def test_a_client_that_leaves_takes_his_calls_with_him(tmp_path: Path) -> None:
    async with served(tmp_path) as (rig, door, path):
        devices(rig)[1].dead = True
        async with dialled(path) as raw:
            raw.ask("settle", names=["s2"], timeout=100)
            raw.ask("scan", bus="arm")
            await asyncio.sleep(0.05)
            next(iter(door.connections)).abort()  # as when its process is killed
        await asyncio.sleep(0.5)
        assert not door.connections
        assert await rig.ping("s2") == 0


@virtual
async def test_health_and_config_tell_no_secret(tmp_path: Path) -> None:
    async with served(tmp_path) as (_, _, path), dialled(path) as raw:
        health = await raw.call("health")
        assert (health["ok"], health["buses"]) == (True, {"arm": True})
        notices = await raw.call("config")
        assert set(notices) == {"version", "buses"}
        assert notices["buses"]["arm"]["servos"]["s1"]["limits"] == [-90.0, 90.0]
