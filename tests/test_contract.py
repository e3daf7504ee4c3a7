"""What a program may rely on, whoever owns the ports: every test here runs over a rig of its own and over a daemon's."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import pytest

from servobus.client import connect
from servobus.config import Config
from servobus.errors import (
    ActionWithheld,
    ConfigError,
    DeviceError,
    EStopped,
    GoalExpired,
    LeaseHeld,
    LimitError,
    LinkDown,
    NotEnabled,
    NotSupported,
    PartialFailure,
    ReplyTimeout,
    UnknownName,
)
from servobus.local import LocalRig
from servobus.opening import open_rig
from servobus.protocols.kst.codec import Command
from servobus.protocols.kst.device import KstDevice
from servobus.protocols.sms.device import SmsDevice
from servobus.protocols.words import Goal, Identity, Outcome, State, StopReport
from servobus.rig import Found, Reload, Rig
from servobus.sim.build import SimLink
from tests.door import open_test_door
from tests.rigs import config, devices
from tests.virtual import virtual

Over = Callable[[Config | Path, Path], AbstractAsyncContextManager[tuple[Rig, LocalRig]]]
"""Config and a folder -> the rig under test, and the one that has the ports."""


@asynccontextmanager
async def own(setup: Config | Path, folder: Path) -> AsyncIterator[tuple[Rig, LocalRig]]:
    async with open_rig(setup) as rig:
        yield rig, rig


@asynccontextmanager
async def daemons(setup: Config | Path, folder: Path) -> AsyncIterator[tuple[Rig, LocalRig]]:
    path = folder / "servobus.sock"
    async with open_rig(setup) as home, open_test_door(home, path), connect(path) as rig:
        yield rig, home


both = pytest.mark.parametrize("over", [own, daemons])


def gone(rig: LocalRig, node: int) -> SmsDevice:
    device = devices(rig)[node]
    device.dead = True
    return device


# Names and reading


@both
@virtual
async def test_names(over: Over, tmp_path: Path) -> None:
    async with over(config(), tmp_path) as (rig, _):
        assert dict(rig.names) == {f"arm/s{number}": ("arm", f"s{number}") for number in (1, 2, 3)}
        assert [servo.name for servo in rig] == list(rig.names)
        assert rig["arm/s2"].name == rig["s2"].name == "arm/s2"
        for unknown in ("elbow", "arm/elbow", "", "leg/s1"):
            with pytest.raises(UnknownName, match="s1"):
                rig[unknown]
            with pytest.raises(UnknownName):
                await rig.read(unknown)
            for verb in (rig.enable, rig.disable, rig.settle, rig.acquire, rig.release):
                with pytest.raises(UnknownName):
                    await verb("s1", unknown)
            with pytest.raises(UnknownName):
                await rig.move({"s1": 1, unknown: 1})


@both
@virtual
async def test_a_name_on_two_buses_is_ambiguous(over: Over, tmp_path: Path) -> None:
    async with over(two_buses(tmp_path), tmp_path) as (rig, _):
        with pytest.raises(UnknownName, match="arm/s1, leg/s1"):
            rig["s1"]
        assert (await rig.read("leg/s1")).position == 0
        assert await rig["s2"].read_register("id") == 2


def two_buses(folder: Path, extra: str = "", leg: int = 1) -> Path:
    path = folder / "two.yaml"
    text = f"""\
version: 1
buses:
  arm: {{protocol: sms, port: "sim:", baudrate: 1000000, servos: {{s1: {{id: 1, model: sts}}, s2: {{id: 2, model: sts}}{extra}}}}}
  leg: {{protocol: sms, port: "sim:", baudrate: 1000000, servos: {{s1: {{id: {leg}, model: sts}}}}}}
"""
    path.write_text(text)
    return path


@both
@virtual
async def test_reading(over: Over, tmp_path: Path) -> None:
    async with over(config(poll="{feedback: 50}"), tmp_path) as (rig, home):
        state = await rig["s1"].read()
        now = asyncio.get_running_loop().time()
        assert isinstance(state, State)
        assert (state.position, state.voltage, state.health, state.enabled) == (0, 12.0, "online", False)
        assert state.faults == ()
        assert state.time is not None
        assert now - state.time == pytest.approx(state.age, abs=0.05)
        frames = home.stats()["arm"]["turns"]
        assert (await rig["s1"].read(max_age=math.inf)).position == 0
        assert home.stats()["arm"]["turns"] - frames <= 1  # a poll at most
        assert await rig["s1"].ping() == 0
        identity = await rig["s1"].identify()
        assert isinstance(identity, Identity)
        assert (identity.model, identity.mode, identity.product) == ("sts", "position", "STS3215")
        assert identity.limits == pytest.approx((-180, 179.912), abs=0.01)
        gone(home, 2)
        with pytest.raises(ReplyTimeout) as caught:
            await rig.read("s2")
        assert (caught.value.bus, caught.value.servo) == ("arm", "s2")


@both
@virtual
async def test_snapshots(over: Over, tmp_path: Path) -> None:
    async with over(config(poll="{feedback: 50}"), tmp_path) as (rig, home):
        assert list(rig.snapshot()) == list(rig.names)
        await rig.enable("s1")
        assert [state.enabled for state in rig.snapshot().values()] == [True, False, False]
        await rig.disable("s1")
        assert not rig.snapshot()["arm/s1"].enabled
        devices(home)[2].joint.position = 1024
        await asyncio.sleep(0.5)
        state = rig.snapshot()["arm/s2"]
        assert state.position == pytest.approx(-90, abs=1)
        assert state.time is not None
        age = asyncio.get_running_loop().time() - state.time
        assert state.age == pytest.approx(age)
        assert age < 0.25


@both
@virtual
async def test_watching(over: Over, tmp_path: Path) -> None:
    async with over(config(poll="{feedback: 50}"), tmp_path) as (rig, _):
        loop = asyncio.get_running_loop()
        begun, count = loop.time(), 0
        async for snapshot in rig.watch(hz=20):
            assert list(snapshot) == list(rig.names)
            assert all(state.age is not None and state.age < 0.1 for state in snapshot.values())
            count += 1
            if count == 21:
                break
        assert 0.9 <= loop.time() - begun <= 1.2
        for hz in (0, -1, 1001, math.nan):
            with pytest.raises(ValueError, match="Hz is outside 0 to 1000"):
                await anext(aiter(rig.watch(hz=hz)))


@both
@virtual
async def test_statistics(over: Over, tmp_path: Path) -> None:
    async with over(config(poll="{feedback: 50}"), tmp_path) as (rig, home):
        assert rig.stats()["arm"]["up"] is True
        await asyncio.sleep(1.5)
        assert rig.stats()["arm"].keys() == home.stats()["arm"].keys()
        assert home.stats()["arm"]["turns"] - rig.stats()["arm"]["turns"] <= 60
        assert rig.stats()["arm"]["nodes"]["1"]["health"] == "online"


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
        for goals in ({"s2": 1, "s1": value}, {"s1": value, "s2": value}, {"s1": 1, "arm/s1": 1}):
            with pytest.raises(LimitError):
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
        {"deadline": "soon"},
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
            await rig["s2"].move_to(5, deadline=0.05)
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
        with pytest.raises(DeviceError, match=r"did not settle within 20 s: it stands at 0\.0"):
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


# Registers, scans, ids


@both
@virtual
async def test_registers(over: Over, tmp_path: Path) -> None:
    async with over(config(), tmp_path) as (rig, _):
        servo = rig["s1"]
        assert await servo.read_register("id") == 1
        assert await servo.read_register("temperature") == 25
        assert await servo.read_register("5:2") == [1, 0]
        assert await servo.write_register("torque_limit", 40) == 40
        assert await servo.read_register("torque_limit", raw=True) == 400
        with pytest.raises(UnknownName, match="present_position"):
            await servo.read_register("positon")
        for value in (math.nan, True, "x", None, b"1", [1], 1e30, 10**30, -1):
            with pytest.raises(LimitError):
                await servo.write_register("torque_limit", value)
        with pytest.raises(NotSupported, match="not written by hand"):
            await servo.write_register("goal_position", 1)
        with pytest.raises(NotSupported, match="persist"):
            await servo.write_register("return_delay", 10, raw=True)
        assert await servo.write_register("return_delay", 10, raw=True, persist=True) == 10
        await servo.enable()
        with pytest.raises(NotSupported, match="disable"):
            await servo.write_register("return_delay", 20, raw=True, persist=True)


@both
@virtual
async def test_a_device_that_refuses(over: Over, tmp_path: Path) -> None:
    async with over(gimbal(), tmp_path) as (rig, home):
        link = cast("SimLink", home.keepers["arm"].link)
        pan = cast("KstDevice", link.line.devices[0])
        for code, kind in ((0x06040043, DeviceError), (0x06060000, DeviceError), (0x06010002, NotSupported)):
            pan.refuses[Command.READ_POSITION] = code
            with pytest.raises(DeviceError, match="refused") as caught:
                await rig["pan"].read_register("position")
            assert isinstance(caught.value, kind)
            assert caught.value.code == code
            assert caught.value.servo == "pan"
            assert caught.value.raw


def gimbal() -> Config:
    servos = ("pan: {id: 1, limits: [-90, 90]}", "tilt: {id: 2, limits: [-90, 90]}")
    return config(*servos, protocol="kst", baudrate=512000)


@both
@virtual
async def test_scanning(over: Over, tmp_path: Path) -> None:
    async with over(config(), tmp_path) as (rig, _):
        progress: list[tuple[int, int, Found | None]] = []
        found = await rig.scan("arm", ids=range(4), progress=lambda *told: progress.append(told))
        assert [(hit.id, hit.model, hit.baudrate) for hit in found] == [(number, "sts", 1000000) for number in (1, 2, 3)]
        assert all(isinstance(hit, Found) for hit in found)
        assert progress == list(zip(range(1, 5), [4] * 4, [None, *found], strict=True))
        assert len(await rig.scan("arm")) == 3
        with pytest.raises(UnknownName, match="arm"):
            await rig.scan("leg")
        with pytest.raises(ZeroDivisionError):
            await rig.scan("arm", ids=[1, 2], progress=fail)
        await asyncio.sleep(1)
        await rig.enable("s1")
        with pytest.raises(LeaseHeld, match="s1"):
            await rig.scan("arm", ids=[1])


def fail(*_: object) -> None:
    raise ZeroDivisionError


@both
@virtual
async def test_giving_an_id(over: Over, tmp_path: Path) -> None:
    async with over(gimbal(), tmp_path) as (rig, _):
        change = await rig.set_id("arm", 1, 9)
        assert (change.node, change.what, change.value, change.saved, change.pending_reboot) == (1, "id", 9, False, True)
        assert "restart" in str(change)
        assert (await rig.set_baudrate("arm", 2, 115200, save=True)).saved
        with pytest.raises(LimitError):
            await rig.set_id("arm", 1, 4000)
        with pytest.raises(UnknownName):
            await rig.set_id("leg", 1, 2)


@both
@virtual
async def test_an_id_that_cannot_be_given(over: Over, tmp_path: Path) -> None:
    async with over(config(), tmp_path) as (rig, _):
        with pytest.raises(NotSupported):
            await rig.set_id("arm", 1, 9)
        with pytest.raises(NotSupported):
            await rig.set_baudrate("arm", 1, 115200)


# What happens


@both
@virtual
async def test_events(over: Over, tmp_path: Path) -> None:
    async with over(config(poll="{feedback: 50}"), tmp_path) as (rig, home):
        heard = []

        async def listen() -> None:
            async for event in rig.events():
                heard.append(event)  # noqa: PERF401 - it never ends

        listening = asyncio.create_task(listen())
        await asyncio.sleep(0.1)
        begun = asyncio.get_running_loop().time()
        device = gone(home, 2)
        await asyncio.sleep(5)
        device.dead = False
        await asyncio.sleep(5)
        await rig.stop()
        await rig.clear()
        await asyncio.sleep(0.1)
        listening.cancel()
        names = [event.name for event in heard]
        assert [name for name in names if name != "servo_note"] == ["servo_offline", "servo_online", "estop", "estop_cleared"]
        assert heard[0].fields["servo"] == "s2"
        assert begun < heard[0].time < begun + 5
        assert not any(event.missed for event in heard)


@both
@virtual
async def test_a_line_that_goes_and_comes(over: Over, tmp_path: Path) -> None:
    async with over(config(poll="{feedback: 50}"), tmp_path) as (rig, home):
        link = home.keepers["arm"].link
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
        assert asdict(report) == {"added": (), "changed": ("arm", "leg"), "removed": ()}
        assert list(rig.names) == ["arm/s1", "arm/s2", "arm/s3", "leg/s1"]
        assert list(rig.snapshot()) == list(rig.names)
        await rig["s3"].enable()
        assert await rig["s3"].move_to(1) is Outcome.ACKED
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
