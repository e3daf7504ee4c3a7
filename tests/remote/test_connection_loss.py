"""RemoteRig and a connection that goes and comes, and leases that are lost. In virtual time."""

from __future__ import annotations

import asyncio
import math
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from servobus.errors import LeaseHeld, LimitError, LinkDown
from servobus.remote.rig import RemoteRig, connect
from servobus.rig.events import Event
from servobus.rig.local import open_rig
from servobus.values import Goal, Outcome
from tests.daemon_in_process import open_test_door
from tests.scripted_daemon import GREETING, STATE, failed, puppet_daemon
from tests.simulated_rigs import config
from tests.virtual_time import virtual
from tests.waiting import ACKED, LEASE, until

# The connection goes and comes


@virtual
async def test_a_lost_connection_fails_calls_and_repeats_none(tmp_path: Path) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        daemon.answers["send_all"] = lambda visitor, _: visitor.transport.abort()
        with pytest.raises(LinkDown, match="send_all was under way and may have been applied"):
            await rig["s1"].move_to(5)
        with pytest.raises(LinkDown, match="nothing was sent, it is tried again by itself"):
            await rig["s1"].move_to(6)
        assert {state.health for state in rig.snapshot().values()} == {"offline"}
        with pytest.raises(LinkDown):
            rig.stats()
        daemon.answers["hello"] = {"result": GREETING | {"stopped": True, "names": {"leg/knee": ["leg", "knee"]}}}
        daemon.answers["snapshot"] = {"result": {"leg/knee": STATE}}
        await until(lambda: list(rig.names) == ["leg/knee"])
        assert rig.stopped
        assert rig.snapshot()["leg/knee"].health == "online"
        assert rig.stats() == {"arm": {"up": True}}
        await asyncio.sleep(1)
        assert len(daemon.calls("send_all")) == 1


@virtual
async def test_it_is_tried_more_and_more_rarely(tmp_path: Path) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        events: list[Event] = []
        reading = asyncio.create_task(listen(rig, events))
        await asyncio.sleep(0.1)
        daemon.answers["hello"] = failed("AccessDenied", "not today")
        daemon.visitor.transport.abort()
        await asyncio.sleep(20)
        assert 12 <= len(daemon.visitors) <= 16  # 0.05, 0.1 ... 2, 2, 2
        with pytest.raises(LinkDown, match="not today"):
            await rig.ping("s1")
        daemon.answers["hello"] = {"result": GREETING}
        await asyncio.sleep(2.1)
        daemon.visitor.notify("events", name="estop", time=1.0, fields={})
        await asyncio.sleep(0.1)
        reading.cancel()
    assert [event.name for event in events] == ["daemon_lost", "daemon_back", "estop"]


async def listen(rig: RemoteRig, events: list[Event]) -> None:
    async for event in rig.events():
        events.append(event)  # noqa: PERF401 - it never ends


@virtual
async def test_watching_goes_on(tmp_path: Path) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        states = []

        async def watch() -> None:
            async for snapshot in rig.watch(hz=50):
                states.append((snapshot["arm/s1"].position, snapshot["arm/s1"].health))  # noqa: PERF401 - it never ends

        watching = asyncio.create_task(watch())
        await until(lambda: states)
        assert {"topic": "state", "hz": 50} in daemon.calls("subscribe")
        for position in range(3):  # a slow reader gets the newest
            daemon.visitor.notify("state", stopped=False, states={"arm/s1": STATE | {"position": position}, "arm/s2": STATE})
        await asyncio.sleep(0.1)
        daemon.visitor.transport.abort()
        await asyncio.sleep(1)
        daemon.visitor.notify("state", stopped=False, states={"arm/s1": STATE | {"position": 9}, "arm/s2": STATE})
        await asyncio.sleep(0.1)
        watching.cancel()
        await asyncio.sleep(0.1)
        assert len(daemon.calls("unsubscribe")) == 1
    assert states == [(1.5, "online"), (2, "online"), (2, "offline"), (9, "online")]


@virtual
async def test_a_watcher_that_leaves_at_once_leaves_no_subscription(tmp_path: Path) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        watching = [asyncio.ensure_future(anext(aiter(rig.watch()))) for _ in range(5)]
        await asyncio.sleep(0)
        for task in watching:
            task.cancel()
        await until(lambda: len(daemon.calls("unsubscribe")) == 5)
        assert len({params["subscription"] for params in daemon.calls("unsubscribe")}) == 5


@virtual
async def test_names_follow_a_reload_by_somebody_else(tmp_path: Path) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        daemon.answers["names"] = {"result": {"arm/s1": ["arm", "s1"], "arm/s9": ["arm", "s9"]}}
        daemon.visitor.notify("state", stopped=True, states={"arm/s1": STATE, "arm/s9": STATE})
        await until(lambda: "arm/s9" in rig.names)
        assert rig.full_name("s9") == "arm/s9"
        assert rig.stopped
        assert list(rig.snapshot()) == ["arm/s1", "arm/s9"]


@pytest.mark.parametrize(
    ("method", "params"),
    [
        ("state", {}),
        ("state", {"stopped": False, "states": 1}),
        ("state", {"stopped": False, "states": {"arm/s1": {"position": "1"}}}),
        ("stats", {}),
        ("event", {"name": 3}),
        ("event", {}),
        ("progress", {}),
    ],
)
@virtual
async def test_a_notice_that_is_none_ends_the_connection(tmp_path: Path, method: str, params: dict[str, Any]) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        events: list[Event] = []
        reading = asyncio.create_task(listen(rig, events))
        await asyncio.sleep(0.1)
        for number in range(5):
            daemon.visitor.say({"method": method, "params": params | {"subscription": number}})
        await until(lambda: len(daemon.visitors) == 2)
        await asyncio.sleep(0.1)
        reading.cancel()
        assert [event.name for event in events] == ["daemon_lost", "daemon_back"]
        assert "another version" in str(events[0].fields["reason"])


# Leases


@virtual
async def test_a_lease_is_renewed_while_it_is_held(tmp_path: Path) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        daemon.answers["send_all"] = ACKED
        daemon.answers["renew"] = {"result": {"names": ["arm/s1"], "lease_ms": 300}}
        assert await rig["s1"].move_to(5) is Outcome.ACKED
        await asyncio.sleep(10 * LEASE)
        renewed = len(daemon.calls("renew"))
        assert 25 <= renewed <= 30
        assert not daemon.calls("acquire")
        await rig.release("s1")
        daemon.answers["renew"] = {"result": {"names": [], "lease_ms": 300}}
        await asyncio.sleep(10 * LEASE)
        assert len(daemon.calls("renew")) <= renewed + 3
    assert daemon.calls("release") == [{"names": ["arm/s1"]}, {}]


@virtual
async def test_what_was_lost_is_acquired_by_the_next_wish_only(tmp_path: Path) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        daemon.answers["send_all"] = failed("LeaseHeld", "its motion lease has expired", bus="arm", servo="s1")
        with pytest.raises(LeaseHeld, match="expired"):
            await rig["s1"].move_to(5)
        assert not daemon.calls("acquire")
        daemon.answers["send_all"] = ACKED
        await rig["s1"].move_to(6)
        assert daemon.calls("acquire") == [{"names": ["arm/s1"]}]
        assert [params["goals"]["arm/s1"]["value"] for params in daemon.calls("send_all")] == [5, 6]


@virtual
async def test_a_client_that_slept_through_its_lease_knows_it(tmp_path: Path) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        daemon.answers["send_all"] = ACKED
        daemon.answers["renew"] = lambda *_: None  # the daemon does not hear of us
        await rig["s1"].move_to(5)
        await asyncio.sleep(2 * LEASE)
        await rig["s1"].move_to(6)
        assert daemon.calls("acquire") == [{"names": ["arm/s1"]}]


@virtual
async def test_another_holder_is_named(tmp_path: Path) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        daemon.answers["send_all"] = daemon.answers["acquire"] = failed("LeaseHeld", "web page moves it", bus="arm", servo="s1")
        for _ in range(2):
            with pytest.raises(LeaseHeld, match="arm/s1: web page moves it"):
                await rig["s1"].move_to(5)
        assert len(daemon.calls("send_all")) == 1  # the second stopped at the lease


@virtual
async def test_leaving(tmp_path: Path) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon:
        daemon.answers["send_all"] = ACKED
        async with connect(tmp_path / "s") as rig:
            await rig["s1"].move_to(5)
        await until(lambda: daemon.visitor.gone)
        assert daemon.calls("release") == [{}]
        with pytest.raises(LinkDown, match=r"has left; nothing was sent$"):
            await rig.ping("s1")
        with pytest.raises(LimitError):  # noqa: PT012 - the context has to see it too
            async with connect(tmp_path / "s") as rig:
                await rig["s1"].move_to(5)
                await rig["s1"].move_to(math.nan)
        await until(lambda: daemon.visitor.gone)
        assert daemon.calls("release") == [{}]
        daemon.answers["release"] = lambda *_: None  # a daemon that hangs does not hold up the end
        async with connect(tmp_path / "s") as rig:
            await rig["s1"].move_to(5)


@virtual
async def test_leaving_while_it_is_lost(tmp_path: Path) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon:
        daemon.answers["send_all"] = ACKED
        async with connect(tmp_path / "s") as rig:
            await rig.send("s1", Goal("velocity", 3))
            daemon.visitor.transport.abort()
            await asyncio.sleep(0)
        count = len(daemon.visitors)
        await asyncio.sleep(5)
        assert len(daemon.visitors) == count


@pytest.mark.parametrize("way", ["release", "normal", "error", "killed"])
@virtual
async def test_what_becomes_of_motion_when_its_client_leaves(tmp_path: Path, way: str) -> None:
    setup, path = config("s1: {id: 1, model: sts, speed: 20, on_lost_client: hold}"), tmp_path / "s"
    async with open_rig(setup) as home, open_test_door(home, path) as door:
        with suppress(ZeroDivisionError):
            async with connect(path) as rig:
                await rig.enable()
                await rig["s1"].move_to(40)
                await asyncio.sleep(1)
                if way == "release":
                    await rig.release()
                    await asyncio.sleep(3)
                if way == "error":
                    raise ZeroDivisionError
                if way == "killed":
                    next(iter(door.connections)).abort()
                    await asyncio.sleep(3)
        await asyncio.sleep(3)
        finished = (await home.read("s1")).position == pytest.approx(40, abs=1)
        assert finished is (way in ("release", "normal"))


@virtual
async def test_two_clients_and_one_servo(tmp_path: Path) -> None:
    path = tmp_path / "s"
    async with open_rig(config()) as home, open_test_door(home, path), connect(path) as first, connect(path) as second:
        await first.enable()
        await first["s1"].move_to(5)
        await asyncio.sleep(5)
        for _ in range(2):
            with pytest.raises(LeaseHeld, match="arm/s1"):
                await second["s1"].move_to(6)
        assert await second["s2"].move_to(6) is Outcome.ACKED
        await second.stop()  # anyone may
        await until(lambda: first.stopped)
        await first.clear()
        await first.release("s1")
        assert await second["s1"].move_to(6) is Outcome.ACKED


def test_a_client_loads_no_engine() -> None:
    code = """
import sys, servobus.remote.rig, servobus.blocking
servobus.connect, servobus.Rig, servobus.LinkDown
engine = (
    "serial",
    "pydantic",
    "ruamel",
    "servobus.bus",
    "servobus.simulation",
    "servobus.engine",
    "servobus.links",
    "servobus.protocols.sms",
)
print([name for name in sys.modules if name.startswith(engine)])
import servobus
assert servobus.open.__name__ == "open_rig" and "open" in dir(servobus)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout == "[]\n"
