"""What a program may rely on in motion, whoever owns the ports: over a rig of its own and over a daemon's."""

from __future__ import annotations

import asyncio
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from servobus.errors import (
    ActionWithheld,
    Busy,
    ConfigError,
    DeviceError,
    EStopped,
    GoalExpired,
    InvalidRequest,
    LimitError,
    LinkDown,
    NotEnabled,
    NotSupported,
    PartialFailure,
    ReplyTimeout,
    SettleTimeout,
)
from servobus.values import Goal, Outcome, Reload, State, StopReport
from tests.rig_kinds import Over, both, gone, two_buses
from tests.simulated_rigs import config, devices
from tests.virtual_time import virtual

# Motion


@both
@virtual
async def test_goals(over: Over, tmp_path: Path) -> None:
    async with over(config(), tmp_path) as (rig, _):
        await rig.enable()
        assert await rig["s1"].move_to(30) is Outcome.ACKED
        state = await rig["s1"].settle()
        assert state.position == pytest.approx(30, abs=0.9)
        assert await rig.move({"s1": 10, "arm/s2": -20}, speed=90) == {"arm/s1": Outcome.SENT, "arm/s2": Outcome.SENT}
        assert list(await rig.settle("s2", "s1")) == ["arm/s2", "arm/s1"]
        assert await rig.move({"s1": 5, "s2": 5}, together=True, confirm=True) == dict.fromkeys(
            ("arm/s1", "arm/s2"), Outcome.ACKED
        )
        assert len(await rig.settle()) == 3
        assert await rig.send("s1", Goal("position", 7, duration=0.5), confirm=True) is Outcome.ACKED
        assert await rig.send_all({"s3": Goal("position", -3)}) == {"arm/s3": Outcome.ACKED}
        assert await rig.move({}) == {}
        first, second = await asyncio.gather(rig["s1"].move_to(5), rig["s1"].move_to(7))
        assert (first, second) == (Outcome.SUPERSEDED, Outcome.ACKED)
        with pytest.raises(NotSupported, match="velocity"):
            await rig["s1"].spin(20)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, True, "1", None, b"1", 10**400, 90.01, -90.01, 1e300])
@both
@virtual
async def test_a_goal_that_is_none(over: Over, tmp_path: Path, value: Any) -> None:
    async with over(config(), tmp_path) as (rig, home):
        await rig.enable()
        turns = home.stats()["arm"]["turns"]
        with pytest.raises(LimitError) as caught:
            await rig["s1"].move_to(value)
        assert (caught.value.bus, caught.value.servo) == ("arm", "s1")
        for goals, refusal in (
            ({"s2": 1, "s1": value}, LimitError),
            ({"s1": value, "s2": value}, LimitError),
            ({"s1": 1, "arm/s1": 1}, InvalidRequest),
        ):
            with pytest.raises(refusal):
                await rig.move(goals)
        assert home.stats()["arm"]["turns"] == turns


@pytest.mark.parametrize(
    "options",
    [
        {"speed": math.nan},
        {"speed": -1},
        {"duration": 0},
        {"speed": 1, "duration": 1},
        {"effort": 101},
        {"acceleration": True},
        {"start_within": "soon"},
    ],
)
@both
@virtual
async def test_an_option_that_is_none(over: Over, tmp_path: Path, options: dict[str, Any]) -> None:
    async with over(config(), tmp_path) as (rig, _):
        await rig.enable()
        with pytest.raises(LimitError, match="arm/s1"):
            await rig["s1"].move_to(1, **options)


@both
@virtual
async def test_what_is_not_enabled_does_not_move(over: Over, tmp_path: Path) -> None:
    async with over(config(), tmp_path) as (rig, _):
        with pytest.raises(NotEnabled, match="enable it first") as caught:
            await rig["s1"].move_to(1)
        assert (caught.value.bus, caught.value.servo) == ("arm", "s1")
        await rig.enable("s1")
        with pytest.raises(NotEnabled, match="arm/s2"):
            await rig.move({"s1": 1, "s2": 1})
        await rig["s1"].disable()
        with pytest.raises(NotEnabled):
            await rig["s1"].move_to(1)


@both
@virtual
async def test_a_part_that_fails(over: Over, tmp_path: Path) -> None:
    async with over(config(), tmp_path) as (rig, home):
        await rig.enable()
        gone(home, 2)
        with pytest.raises(ReplyTimeout):
            await rig.read("s2")
        with pytest.raises(PartialFailure, match="1 of 2 failed: arm/s2") as caught:
            await rig.move({"s1": 3, "s2": 3})
        assert caught.value.results["arm/s1"] is Outcome.ACKED
        error = caught.value.results["arm/s2"]
        assert isinstance(error, GoalExpired)
        assert (error.bus, error.servo) == ("arm", "s2")
        with pytest.raises(GoalExpired):
            await rig["s2"].move_to(5, start_within=0.05)
        with pytest.raises(PartialFailure) as caught:
            await rig.disable()
        assert caught.value.results["arm/s1"] is None
        assert isinstance(caught.value.results["arm/s2"], (ReplyTimeout, DeviceError))


@both
@virtual
async def test_a_group_that_is_withheld(over: Over, tmp_path: Path) -> None:
    async with over(config(), tmp_path) as (rig, home):
        await rig.enable()
        gone(home, 2)
        with pytest.raises(PartialFailure) as caught:
            await rig.move({"s1": 9, "s2": 9}, together=True, confirm=True)
        assert isinstance(caught.value.results["arm/s1"], ActionWithheld)


@both
@virtual
async def test_settle_says_where_it_stands(over: Over, tmp_path: Path) -> None:
    async with over(config(), tmp_path) as (rig, home):
        await rig.enable()
        devices(home)[1].joint.stuck = True
        await rig["s1"].move_to(30)
        with pytest.raises(SettleTimeout, match=r"did not settle within 20 s: it is at 0\.0"):
            await rig["s1"].settle(timeout=20)
        devices(home)[1].joint.stuck = False
        assert (await rig["s1"].settle(timeout=math.inf, tolerance=2)).position == pytest.approx(30, abs=2)


@both
@virtual
async def test_stop_and_clear(over: Over, tmp_path: Path) -> None:
    async with over(config(), tmp_path) as (rig, home):
        await rig.enable()
        await rig.move({"s1": 80, "s2": 80, "s3": 80})
        gone(home, 2)
        reports = await rig.stop()
        assert all(isinstance(report, StopReport) for report in reports.values())
        assert reports["arm/s1"] == StopReport("hold", True, True)
        assert reports["arm/s3"] == StopReport("limp", True, True)
        assert not reports["arm/s2"].confirmed
        assert rig.stopped
        assert not rig.snapshot()["arm/s3"].enabled
        for refused in (rig["s1"].move_to(0), rig.enable("s1"), rig["s1"].settle()):
            with pytest.raises(EStopped):
                await refused
        await rig.clear()
        assert (await rig["s1"].move_to(0), rig.stopped) == (Outcome.ACKED, False)


@both
@virtual
async def test_leases_that_nobody_contests(over: Over, tmp_path: Path) -> None:
    async with over(config(), tmp_path) as (rig, _):
        await rig.enable()
        await rig.acquire("s1")
        await asyncio.sleep(3)
        assert await rig["s1"].move_to(1) is Outcome.ACKED
        await rig.release("s1")
        await rig.release()
        await rig.acquire()
        await asyncio.sleep(3)
        assert await rig.move({"s1": 2, "s2": 2}) == dict.fromkeys(("arm/s1", "arm/s2"), Outcome.SENT)
        await asyncio.sleep(3)
        assert (await rig["s1"].settle()).position == pytest.approx(2, abs=0.9)


# What happens


@both
@virtual
async def test_events(over: Over, tmp_path: Path) -> None:
    async with over(config(poll="{feedback: 50}"), tmp_path) as (rig, home):
        events = []

        async def read_events() -> None:
            async for event in rig.events():
                events.append(event)  # noqa: PERF401 - it never ends

        reading = asyncio.create_task(read_events())
        await asyncio.sleep(0.1)
        begun = asyncio.get_running_loop().time()
        device = gone(home, 2)
        await asyncio.sleep(5)
        device.dead = False
        await asyncio.sleep(5)
        await rig.stop()
        await rig.clear()
        await asyncio.sleep(0.1)
        reading.cancel()
        names = [event.name for event in events]
        assert [name for name in names if name != "servo_note"] == ["servo_offline", "servo_online", "estop", "estop_cleared"]
        assert events[0].fields["servo"] == "s2"
        assert begun < events[0].time < begun + 5
        assert not any(event.missed for event in events)


@both
@virtual
async def test_events_begin_at_the_call(over: Over, tmp_path: Path) -> None:
    """What happens between `events()` and the first `anext` is not lost."""
    async with over(config(), tmp_path) as (rig, _):
        events = rig.events()
        await rig.stop()
        await rig.clear()
        await asyncio.sleep(0.1)
        async with asyncio.timeout(1):
            assert [(await anext(events)).name for _ in range(2)] == ["estop", "estop_cleared"]
        await events.aclose()
        with pytest.raises(StopAsyncIteration):
            await anext(events)


@both
@virtual
async def test_a_line_that_goes_and_comes(over: Over, tmp_path: Path) -> None:
    async with over(config(poll="{feedback: 50}"), tmp_path) as (rig, home):
        link = home.supervisors["arm"].link
        link.unplug()  # type: ignore[attr-defined]
        with pytest.raises(LinkDown, match="arm"):
            await rig.read("s1")
        link.plug()  # type: ignore[attr-defined]
        await asyncio.sleep(1)
        assert (await rig.read("s1")).position == 0


@both
@virtual
async def test_reading_the_config_anew(over: Over, tmp_path: Path) -> None:
    path = two_buses(tmp_path)
    async with over(path, tmp_path) as (rig, _):
        assert await rig.reload() == Reload()
        two_buses(tmp_path, ", s3: {id: 3, model: sts}", leg=4)
        report = await rig.reload()
        assert asdict(report) == {"added": (), "changed": ("arm", "leg"), "removed": (), "updated": ()}
        assert list(rig.names) == ["arm/s1", "arm/s2", "arm/s3", "leg/s1"]
        assert list(rig.snapshot()) == list(rig.names)
        await rig["s3"].enable()
        assert await rig["s3"].move_to(1) is Outcome.ACKED
        two_buses(tmp_path, leg=5)
        with pytest.raises(Busy, match="arm/s3"):
            await rig.reload()
        assert (await rig.reload(force=True)).changed == ("arm", "leg")
        two_buses(tmp_path, ", s3: {id: 3, model: sts}", leg=4)
        await rig.reload()
        path.write_text("version: 1\n")
        with pytest.raises(ConfigError, match=r"two\.yaml"):
            await rig.reload()
        assert "arm/s3" in rig.names


@both
@virtual
async def test_a_config_that_is_no_file(over: Over, tmp_path: Path) -> None:
    async with over(config(), tmp_path) as (rig, _):
        with pytest.raises(NotSupported, match="not opened from a file"):
            await rig.reload()


@both
@virtual
async def test_a_caller_that_is_cancelled_tears_nothing(over: Over, tmp_path: Path) -> None:
    async with over(config(), tmp_path) as (rig, _):
        reading = [asyncio.create_task(rig.read("s1")) for _ in range(20)]
        await asyncio.sleep(0)
        for task in reading[::2]:
            task.cancel()
        results = await asyncio.gather(*reading, return_exceptions=True)
        assert [type(result) for result in results] == [asyncio.CancelledError, State] * 10
