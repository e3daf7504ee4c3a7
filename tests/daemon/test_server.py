"""The native door as any program meets it: JSON-RPC by the letter, leases, stops before everything."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest

from servobus.daemon.connection import MAX_TASKS
from servobus.rpc.clock import machine
from servobus.rpc.methods import MAX_BATCH, MAX_LINE
from tests.daemon.raw_client import dialled, served
from tests.simulated_rigs import config
from tests.virtual_time import virtual

SLOW = "s1: {id: 1, model: sts, speed: 20}", "s2: {id: 2, model: sts, speed: 20}"

BAD: list[tuple[bytes, int]] = [
    (b"nonsense\n", -32700),
    (b'{"jsonrpc":"2.0","id":1,"method":"read","params":{"name":"s1","max_age":NaN}}\n', -32700),
    (b'{"jsonrpc":"2.0","id":1,"method":"read","params":{"name":"s1","max_age":Infinity}}\n', -32700),
    (b'{"jsonrpc":"2.0","id":1,"method":"names","method":"stop"}\n', -32700),
    (b'{"jsonrpc":"2.0","id":1,"method":"move","params":{"positions":{"s1":1,"s1":2}}}\n', -32700),
    (b"[" * 30_000 + b"\n", -32700),
    (b'{"a":' * 10_000 + b"\n", -32700),
    (b'{"jsonrpc":"2.0","id":' + b"9" * 60_000 + b',"method":"names"}\n', -32700),
    (b"[]\n", -32600),
    (b"[" + b"1," * MAX_BATCH + b"1]\n", -32600),
    (b"5\n", -32600),
    (b'{"jsonrpc":"1.0","id":1,"method":"names"}\n', -32600),
    (b'{"jsonrpc":"2.0","id":[1],"method":"names"}\n', -32600),
    (b'{"jsonrpc":"2.0","id":true,"method":"names"}\n', -32600),
    (b'{"jsonrpc":"2.0","id":1,"method":"names","extra":1}\n', -32600),
    (b'{"jsonrpc":"2.0","id":1}\n', -32601),
    (b'{"jsonrpc":"2.0","id":1,"method":"raw_frame"}\n', -32601),
    (b'{"jsonrpc":"2.0","id":1,"method":["stop"]}\n', -32601),
    (b'{"jsonrpc":"2.0","id":1,"method":"read"}\n', -32602),
    (b'{"jsonrpc":"2.0","id":1,"method":"read","params":{"name":5}}\n', -32602),
    (b'{"jsonrpc":"2.0","id":1,"method":"read","params":{"name":"s1","colour":5}}\n', -32602),
    (b'{"jsonrpc":"2.0","id":1,"method":"read","params":["s1",1,2]}\n', -32602),
    (b'{"jsonrpc":"2.0","id":1,"method":"read","params":"s1"}\n', -32602),
]


@pytest.mark.parametrize(("line", "code"), BAD)
@virtual
async def test_a_wrong_call_is_refused_and_the_next_is_done(line: bytes, code: int, tmp_path: Path) -> None:
    async with served(tmp_path) as (_, _, path), dialled(path) as raw:
        raw.say(line)
        answer = await raw.line()
        first = answer[0] if isinstance(answer, list) else answer
        assert first["error"]["code"] == code
        assert len(json.dumps(first)) < 2000, "what was said is not said back"
        assert await raw.call("stopped") is False


@virtual
async def test_a_line_without_an_end_closes_the_connection(tmp_path: Path) -> None:
    async with served(tmp_path) as (_, door, path), dialled(path) as raw:
        raw.say(b"x" * (MAX_LINE + 1))
        assert (await raw.line())["error"]["code"] == -32600
        assert await raw.line() is None
        assert not door.connections


@virtual
async def test_a_line_that_comes_byte_by_byte(tmp_path: Path) -> None:
    async with served(tmp_path) as (_, _, path), dialled(path) as raw:
        for byte in b'{"jsonrpc":"2.0","id":"a","method":"stopped"}\n':
            raw.say(bytes((byte,)))
            await asyncio.sleep(0.001)
        assert await raw.line() == {"jsonrpc": "2.0", "id": "a", "result": False}


@virtual
async def test_batches_positions_notifications_and_ids(tmp_path: Path) -> None:
    async with served(tmp_path) as (rig, _, path), dialled(path) as raw:
        calls: list[Any] = [
            {"jsonrpc": "2.0", "id": None, "method": "stopped"},
            {"jsonrpc": "2.0", "method": "stopped"},
            {"jsonrpc": "2.0", "id": 1.5, "method": "read_register", "params": ["s1", "id"]},
            5,
            {"jsonrpc": "2.0", "id": "x", "method": "read", "params": {"name": "nobody"}},
        ]
        raw.say(json.dumps(calls).encode() + b"\r\n")
        answers = await raw.line()
        assert [answer["id"] for answer in answers] == [None, 1.5, None, "x"]
        assert answers[1]["result"] == 1
        assert answers[3]["error"]["data"]["type"] == "UnknownName"
        raw.say(b'{"jsonrpc":"2.0","method":"clear"}\n\n')
        assert (await raw.call("names")) == {name: list(position) for name, position in rig.names.items()}


# Stops and leases


@virtual
async def test_a_stop_goes_before_everything_that_came_with_it(tmp_path: Path) -> None:
    async with served(tmp_path, rate=None) as (rig, _, path), dialled(path) as raw:
        await rig.enable()
        flood = [raw.ask("read", name="s1") for _ in range(200)]
        stop = raw.ask("stop")
        answers = [await raw.line() for _ in range(201)]
        order = [answer["id"] for answer in answers]
        assert sorted(order) == sorted([*flood, stop])
        assert order.index(stop) < 60, "it did not wait for the flood"
        report = next(answer["result"] for answer in answers if answer["id"] == stop)
        assert all(servo["written"] and servo["confirmed"] for servo in report.values())
        assert rig.stopped


@virtual
async def test_stops_and_renewals_wait_for_no_call_under_way(tmp_path: Path) -> None:
    """More calls that take long than may be under way at once, and another that waits for them."""
    async with served(tmp_path, config(*SLOW), rate=50) as (rig, _, path), dialled(path) as raw:
        await raw.call("enable")
        assert await raw.call("move_to", name="s1", position=60) == "acked"
        for _ in range(MAX_TASKS + 10):
            raw.ask("settle", names=["s1"], timeout=100, tolerance=0.001)
        late = raw.ask("names")
        for _ in range(8):
            await asyncio.sleep(0.2)
            lease = await raw.call("renew")
            assert lease["names"] == ["arm/s1"]
        assert (rig.snapshot()["arm/s1"].position or 0) > 20, "its lease held over more than its time"
        raw.say(json.dumps([{"jsonrpc": "2.0", "id": 0, "method": method} for method in ("names", "stop")]).encode() + b"\n")
        message = await raw.line()
        while not isinstance(message, list):
            assert message["id"] != late
            message = await raw.line()
        assert message[1]["result"]["arm/s1"]["confirmed"]


@virtual
async def test_a_flood_of_stops_waits_as_any_other(tmp_path: Path) -> None:
    async with served(tmp_path, rate=None) as (rig, _, path), dialled(path) as raw, dialled(path) as other:
        stops = [raw.ask("stop") for _ in range(1000)]
        asked = other.ask("names")
        assert (await other.line())["id"] == asked
        assert {(await raw.line())["id"] for _ in stops} == set(stops)
        assert rig.stopped


@virtual
async def test_who_leaves_in_the_middle_of_a_batch(tmp_path: Path) -> None:
    async with served(tmp_path) as (_, door, path):
        async with dialled(path) as raw:
            calls = [{"jsonrpc": "2.0", "id": at, "method": "settle", "params": {"timeout": 50}} for at in range(3)]
            raw.say(json.dumps(calls).encode() + b"\n")
            await asyncio.sleep(0.1)
            next(iter(door.connections)).abort()
        await asyncio.sleep(0.1)
        assert not door.connections


@virtual
async def test_a_lease_is_taken_by_moving_and_names_its_holder(tmp_path: Path) -> None:
    async with served(tmp_path, config(*SLOW)) as (_, _, path), dialled(path) as one, dialled(path) as two:
        await one.call("hello", client="arm script\x1b[2J")
        await one.call("enable")
        assert await one.call("move_to", name="s1", position=60) == "acked"
        for method, params in (
            ("move_to", {"name": "s1", "position": 1}),
            ("acquire", {"names": ["s1"]}),
            ("disable", {"names": ["s1"]}),
            ("write_register", {"name": "s1", "register": "torque_limit", "value": 50}),
            ("scan", {"bus": "arm", "ids": [1]}),
        ):
            refused = await two.call(method, **params)
            assert refused["type"] == "LeaseHeld"
            assert "arm script?[2J (pid " in refused["message"]
        assert list(await two.call("leases")) == ["arm/s1"]
        assert await two.call("move_to", name="s2", position=1) == "acked", "another servo is free"
        assert (await two.call("stop"))["arm/s1"]["confirmed"], "anyone may stop"


REFUSED: dict[str, tuple[str, dict[str, Any]]] = {
    "limit": ("move_to", {"name": "s1", "position": 999}),
    "speed": ("move", {"positions": {"s1": 1}, "speed": -1}),
    "kind": ("spin", {"name": "s1", "velocity": 5}),
    "one of two": ("send_all", {"goals": {"s1": {"kind": "position", "value": 1}, "s2": {"kind": "position", "value": 999}}}),
    "late": ("move_to", {"name": "s1", "position": 1, "asked": -99.0}),
    "not enabled": ("move_to", {"name": "s3", "position": 1}),
}


@pytest.mark.parametrize("refused", REFUSED, ids=str)
@virtual
async def test_a_refused_motion_takes_no_lease(refused: str, tmp_path: Path) -> None:
    """So the loss of a client that has moved nothing makes no servo go limp, and keeps nobody else from moving it."""
    method, params = REFUSED[refused]
    limp = [servo.replace("speed", "on_lost_client: limp, limits: [-90, 90], speed") for servo in SLOW]
    async with served(tmp_path, config(*limp, "s3: {id: 3, model: sts}")) as (rig, _, path), dialled(path) as owner:
        await owner.call("enable", names=["s1", "s2"])
        async with dialled(path) as stranger:
            await stranger.call("hello", machine=machine())
            assert (await stranger.call(method, **params))["type"] in ("LimitError", "NotSupported", "GoalExpired", "NotEnabled")
            assert await owner.call("leases") == {}
        await asyncio.sleep(1)
        assert [name for name, state in rig.snapshot().items() if state.enabled] == ["arm/s1", "arm/s2"]


@virtual
async def test_a_refused_motion_ends_no_lease(tmp_path: Path) -> None:
    async with served(tmp_path, config(*SLOW)) as (_, _, path), dialled(path) as raw:
        await raw.call("enable")
        await raw.call("move_to", name="s1", position=60)
        assert (await raw.call("move_to", name="s1", position=9999))["type"] == "LimitError"
        assert list(await raw.call("leases")) == ["arm/s1"]


@virtual
async def test_an_expired_lease_stops_servos_and_refuses_old_goals(tmp_path: Path) -> None:
    async with served(tmp_path, config(*SLOW), lease_ms=300) as (rig, _, path), dialled(path) as raw, dialled(path) as other:
        await raw.call("enable")
        watching = await other.call("subscribe", topic="events")
        await raw.call("move_to", name="s1", position=80)
        await asyncio.sleep(1)
        stood = (await rig.read("s1")).position
        assert stood == pytest.approx(6, abs=3), "0.3 s at 20 degrees/s"
        refused = await raw.call("move_to", name="s1", position=80)
        assert (refused["type"], "acquire it again" in refused["message"]) == ("LeaseHeld", True)
        assert (await raw.call("renew"))["names"] == []
        assert (await rig.read("s1")).position == stood
        assert (await raw.call("acquire", names=["s1"]))["lease_ms"] == 300
        assert await raw.call("move_to", name="s1", position=80) == "acked"
        await other.call("stopped")
        events = [note["params"]["name"] for note in other.notices if note["params"]["subscription"] == watching]
        assert events == ["lease_lost"]


@pytest.mark.parametrize(("end", "position"), [("released", 40), ("renewed", 40), ("gone", 12)])
@virtual
async def test_how_motion_ends(end: str, position: float, tmp_path: Path) -> None:
    async with served(tmp_path, config(*SLOW), lease_ms=200) as (rig, door, path):
        async with dialled(path) as raw:
            await raw.call("enable")
            await raw.call("move_to", name="s1", position=40)
            if end == "released":
                await raw.call("release")
            for _ in range(5 if end == "gone" else 40):
                await asyncio.sleep(0.1)
                if end != "released":
                    await raw.call("renew")
        await asyncio.sleep(3)
        assert (await rig.read("s1")).position == pytest.approx(position, abs=6)
        assert door.leases.holders() == {}


@virtual
async def test_the_name_of_another_client_does_not_bring_its_lease(tmp_path: Path) -> None:
    async with served(tmp_path, config(*SLOW)) as (_, _, path), dialled(path) as one, dialled(path) as two:
        for client in (one, two):
            await client.call("hello", client="arm script")
        await one.call("acquire", names=["s1"])
        assert (await two.call("renew"))["names"] == []
        assert (await two.call("release")) is None
        assert list(await one.call("leases")) == ["arm/s1"]
