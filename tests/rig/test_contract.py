"""What a program may rely on, whoever owns the ports: every test here runs over a rig of its own and over a daemon's."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path
from typing import cast

import pytest

from servobus.config.loader import Config
from servobus.errors import Busy, DeviceError, LimitError, NotSupported, ReplyTimeout, UnknownName
from servobus.protocols.kst.codec import Command
from servobus.protocols.kst.simulated.device import KstDevice
from servobus.simulation.link import SimulatedLink
from servobus.values import Identity, ScanHit, State
from tests.rig_kinds import Over, both, gone, two_buses
from tests.simulated_rigs import config, devices
from tests.virtual_time import virtual

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
        link = cast("SimulatedLink", home.supervisors["arm"].link)
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
        progress: list[tuple[int, int, ScanHit | None]] = []
        hits = await rig.scan("arm", ids=range(4), progress=lambda *report: progress.append(report))
        assert [(hit.id, hit.model, hit.baudrate) for hit in hits] == [(number, "sts", 1000000) for number in (1, 2, 3)]
        assert all(isinstance(hit, ScanHit) for hit in hits)
        assert progress == list(zip(range(1, 5), [4] * 4, [None, *hits], strict=True))
        assert len(await rig.scan("arm")) == 3
        with pytest.raises(UnknownName, match="arm"):
            await rig.scan("leg")
        with pytest.raises(ZeroDivisionError):
            await rig.scan("arm", ids=[1, 2], progress=fail)
        await asyncio.sleep(1)
        await rig.enable("s1")
        with pytest.raises(Busy, match="s1"):
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
