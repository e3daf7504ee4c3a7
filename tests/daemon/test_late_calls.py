"""Nothing is sent late: a goal's time counts from its caller's clock, and a caller that gave up is heard."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from servobus.errors import GoalExpired
from servobus.remote.rig import connect
from servobus.rpc.clock import machine
from tests.cli.processes import LIMP, servobus, until
from tests.daemon.raw_client import Raw, dialled, served
from tests.simulated_rigs import devices
from tests.virtual_time import virtual

GOALS: dict[str, dict[str, Any]] = {
    "move_to": {"name": "s1", "position": 10},
    "move": {"positions": {"s1": 10}},
    "send_all": {"goals": {"s1": {"kind": "position", "value": 10}}},
}
ACKED = ("acked", {"arm/s1": "acked"})
every_goal = pytest.mark.parametrize("method", GOALS)


def now() -> float:
    return asyncio.get_running_loop().time()


async def ready(raw: Raw, *, here: bool = True) -> None:
    await raw.call("hello", machine=machine() if here else "elsewhere", asked=now() + (0 if here else 5000))
    await raw.call("enable", names=["s1"])


@every_goal
@virtual
async def test_a_goal_that_was_on_its_way_for_too_long_is_not_sent(method: str, tmp_path: Path) -> None:
    async with served(tmp_path) as (rig, _, path), dialled(path) as raw:
        await ready(raw)
        await asyncio.sleep(5)
        before = devices(rig)[1].get("goal_position")
        answer = await raw.call(method, **GOALS[method], asked=now() - 0.3)
        assert answer["type"] == "GoalExpired"
        assert "on its way for 0.3 s" in answer["message"]
        assert devices(rig)[1].get("goal_position") == before
        assert await raw.call(method, **GOALS[method], asked=now() - 0.1) in ACKED


@every_goal
@virtual
async def test_the_clock_of_another_machine_is_learned(method: str, tmp_path: Path) -> None:
    async with served(tmp_path) as (_, _, path), dialled(path) as raw:
        await ready(raw, here=False)
        assert await raw.call(method, **GOALS[method], asked=now() + 5000) in ACKED
        assert (await raw.call(method, **GOALS[method], asked=now() + 4997))["type"] == "GoalExpired"
        assert await raw.call(method, **GOALS[method]) in ACKED, "it does not say when"


@virtual
async def test_the_time_that_is_left_counts_on_the_line_too(tmp_path: Path) -> None:
    """The servo is silent, so its goal waits; the second that its caller gave began before the daemon read it."""
    async with served(tmp_path) as (rig, _, path), dialled(path) as raw:
        await ready(raw)
        devices(rig)[1].dead = True
        await raw.call("read", name="s1")
        begun = now()
        answer = await raw.call("move_to", name="s1", position=10, start_within=1.0, asked=begun - 0.6)
        assert answer["type"] == "GoalExpired"
        assert now() - begun < 0.5


@every_goal
@virtual
async def test_a_call_that_is_cancelled_while_it_waits_does_not_begin(method: str, tmp_path: Path) -> None:
    async with served(tmp_path) as (rig, _, path), dialled(path) as raw:
        await ready(raw)
        before = devices(rig)[1].get("goal_position")
        number = raw.ask(method, **GOALS[method])
        raw.ask("cancel", call=number)  # both lines are read together
        assert (await raw.call("ping", name="s1")) == 0
        await asyncio.sleep(0.1)
        assert devices(rig)[1].get("goal_position") == before


@virtual
async def test_a_caller_that_is_cancelled_withdraws_its_goal(tmp_path: Path) -> None:
    async with served(tmp_path) as (rig, _, path), connect(path) as client:
        await client.enable("s1")
        device = devices(rig)[1]
        before = device.get("goal_position")
        device.dead = True
        with suppress(Exception):
            await client.read("s1")
        moving = asyncio.create_task(client["s1"].move_to(10, start_within=30))
        await asyncio.sleep(0.01)
        moving.cancel()
        await asyncio.sleep(0.05)
        device.dead = False
        await asyncio.sleep(5)
        assert device.get("goal_position") == before


@contextmanager
def standing_still(daemon: subprocess.Popen[str]) -> Iterator[None]:
    os.kill(daemon.pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(daemon.pid, signal.SIGCONT)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["move_to", "move"])
async def test_a_call_that_does_not_say_when_it_was_made_is_as_old_as_the_daemon_stood_still(method: str, tmp_path: Path) -> None:
    config, path = tmp_path / "rig.yaml", tmp_path / "d" / "servobus.sock"
    config.write_text(LIMP.replace("shoulder", "s1"))
    with servobus("run", str(config), SERVOBUS_SOCKET=str(path)) as daemon:
        until(daemon, "running")
        async with dialled(path) as raw, dialled(path) as other:
            await raw.call("enable", names=["s1"])
            with standing_still(daemon):
                answer = asyncio.create_task(raw.call(method, **GOALS[method]))
                await asyncio.sleep(0.5)
            assert (await answer)["type"] == "GoalExpired"
            assert (await other.call("read", name="s1"))["goal"] == 0.0
            await asyncio.sleep(0.2)
            assert await raw.call(method, **GOALS[method]) in ACKED
        daemon.terminate()
        assert daemon.wait(10) == 0


@virtual
async def test_goals_of_a_flood_that_waited_for_their_turn_are_not_sent_late(tmp_path: Path) -> None:
    async with served(tmp_path, rate=10) as (_, _, path), dialled(path) as raw:
        await ready(raw)
        numbers = [raw.ask("move_to", name="s1", position=10 + each) for each in range(20)]
        answers: dict[int, str] = {}
        while len(answers) < len(numbers):
            message = await raw.line()
            answers[message["id"]] = message.get("result") or message["error"]["data"]["type"]
        assert {*answers.values()} == {"acked", "superseded", "GoalExpired"}
        assert answers[numbers[-1]] == "GoalExpired"


@pytest.mark.slow
async def test_goals_that_waited_for_a_daemon_that_stood_still_are_not_sent(tmp_path: Path) -> None:
    config, path = tmp_path / "rig.yaml", tmp_path / "d" / "servobus.sock"
    config.write_text(LIMP)
    with servobus("run", str(config), SERVOBUS_SOCKET=str(path)) as daemon:
        until(daemon, "running")
        async with connect(path) as rig:
            await rig.enable()
            async with connect(path) as gone:
                with standing_still(daemon):
                    waits = asyncio.create_task(rig["shoulder"].move_to(40))
                    with pytest.raises(TimeoutError):
                        await asyncio.wait_for(rig["elbow"].move_to(40, start_within=60), 0.3)
                    leaving = asyncio.create_task(gone["elbow"].move_to(50, start_within=60))
                    await asyncio.sleep(0.1)
                    gone._session._connection.fail("as if it were killed")  # type: ignore[union-attr]
                    with suppress(Exception):
                        await leaving
                with pytest.raises(GoalExpired, match="on its way for"):
                    await waits
                await rig.ping("shoulder")
                states = {name: (await rig.read(name)).goal for name in rig.names}
                assert states == {"arm/shoulder": 0.0, "arm/elbow": 0.0}
                await gone._session.close(lost=True)
        daemon.terminate()
        assert daemon.wait(10) == 0
