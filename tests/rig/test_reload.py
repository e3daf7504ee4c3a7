"""Reading the config anew: all of it or nothing, and only what changed is disturbed."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from servobus.errors import Busy, ConfigError, EStopped, LinkDown, NotSupported, UnknownName
from servobus.rig.local import open_rig
from servobus.values import Reload
from tests.simulated_rigs import config, devices
from tests.virtual_time import virtual

TWO = """version: 1
buses:
  arm:
    protocol: sms
    port: "sim:"
    baudrate: 1000000
    servos: {s1: {id: 1, model: sts, on_exit: limp}}
  leg:
    protocol: sms
    port: "sim:"
    baudrate: 1000000
    servos: {s2: {id: 2, model: sts}}
"""


def write(path: Path, text: str) -> None:
    path.write_text(text)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    file = tmp_path / "rig.yaml"
    file.write_text(TWO)
    return file


@virtual
async def test_nothing_changed_nothing_happens(path: Path) -> None:
    async with open_rig(path) as rig:
        before = dict(rig.buses)
        await rig.enable()
        assert await rig.reload() == Reload()
        assert rig.buses == before
        assert rig.snapshot()["arm/s1"].enabled


@virtual
async def test_another_order_of_keys_and_servos_is_no_change(path: Path) -> None:
    text = TWO.replace(
        "{s1: {id: 1, model: sts, on_exit: limp}}", "{s1: {id: 1, model: sts, on_exit: limp}, s3: {id: 3, model: sts}}"
    )
    write(path, text)
    async with open_rig(path) as rig:
        before = dict(rig.buses)
        await rig.enable()
        other = "{s3: {model: sts, id: 3}, s1: {on_exit: limp, id: 1, model: sts}}"
        write(path, text.replace("{s1: {id: 1, model: sts, on_exit: limp}, s3: {id: 3, model: sts}}", other))
        assert await rig.reload() == Reload()
        assert rig.buses == before
        assert rig.snapshot()["arm/s1"].enabled


@virtual
async def test_a_changed_bus_is_left_as_at_exit_and_the_others_go_on(path: Path) -> None:
    async with open_rig(path) as rig:
        await rig.enable()
        old, leg = devices(rig)[1], rig.buses["leg"]
        write(path, TWO.replace("id: 1,", "id: 7,"))
        assert await rig.reload(force=True) == Reload(changed=("arm",))
        assert old.get("torque_enable") == 0
        assert rig.left["arm/s1"].confirmed
        assert rig.buses["leg"] is leg
        assert rig.snapshot()["leg/s2"].enabled
        await rig.supervisors["arm"].tried.wait()
        assert list(devices(rig)) == [7]
        assert (await rig["s1"].read()).enabled is False


@pytest.mark.parametrize("other", [TWO.replace("id: 1,", "id: 7,"), TWO.replace("arm:", "hip:"), TWO.replace("{s1:", "{s9:")])
@virtual
async def test_a_bus_with_an_enabled_servo_is_neither_opened_again_nor_removed(path: Path, other: str) -> None:
    async with open_rig(path) as rig:
        await rig.enable()
        before, old = dict(rig.buses), devices(rig)[1]
        write(path, other)
        with pytest.raises(
            Busy, match=r"opens again arm, while these servos are enabled.*: arm/s1; disable them first, or force"
        ):
            await rig.reload()
        assert rig.buses == before
        assert old.get("torque_enable") == 1
        assert rig.snapshot()["arm/s1"].enabled
        await rig.disable("arm/s1")
        report = await rig.reload()
        assert (*report.changed, *report.removed) == ("arm",)
        assert rig.buses["leg"] is before["leg"]
        assert rig.snapshot()["leg/s2"].enabled


@virtual
async def test_a_bus_that_owes_a_stop_is_not_opened_again(path: Path) -> None:
    async with open_rig(path) as rig:
        await rig.enable()
        device = devices(rig)[1]
        device.dead = True
        await rig.stop()
        assert await rig.clear() == ("arm/s1",)
        device.dead = False
        write(path, TWO.replace("id: 1,", "id: 7,"))
        with pytest.raises(Busy, match="owe a stop: arm/s1"):
            await rig.reload()
        await asyncio.sleep(3)
        await rig.disable("arm/s1")
        assert await rig.reload() == Reload(changed=("arm",))


@pytest.mark.parametrize("force", [False, True])
@virtual
async def test_a_session_is_not_torn(path: Path, force: bool) -> None:
    async with open_rig(path) as rig:
        scanning = asyncio.create_task(rig.scan("arm", ids=[1]))
        await asyncio.sleep(0.001)
        write(path, TWO.replace("id: 1,", "id: 7,"))
        with pytest.raises(Busy, match="a scan or commissioning session has arm"):
            await rig.reload(force=force)
        assert [hit.id for hit in await scanning] == [1]
        assert await rig.reload(force=force) == Reload(changed=("arm",))


@virtual
async def test_buses_come_and_go(path: Path) -> None:
    async with open_rig(path) as rig:
        waiting = asyncio.create_task(rig["leg/s2"].read())
        await asyncio.sleep(0)
        write(path, TWO.replace("  leg:", "  hip:").replace("s2:", "s9:"))
        assert await rig.reload() == Reload(added=("hip",), removed=("leg",))
        assert list(rig.names) == ["arm/s1", "hip/s9"]
        with pytest.raises(LinkDown):
            await waiting
        with pytest.raises(UnknownName, match="arm/s1, hip/s9"):
            rig["leg/s2"]
        await rig.supervisors["hip"].tried.wait()
        assert (await rig["s9"].read()).position == 0


@virtual
async def test_an_invalid_file_changes_nothing(path: Path) -> None:
    async with open_rig(path) as rig:
        await rig.enable()
        before = dict(rig.buses)
        write(path, TWO.replace("id: 2", "id: 999"))
        with pytest.raises(ConfigError, match=r"rig\.yaml:12:23"):
            await rig.reload()
        assert rig.buses == before
        assert rig.snapshot()["arm/s1"].enabled


@virtual
async def test_the_e_stop_holds_on_new_buses_too(path: Path) -> None:
    async with open_rig(path) as rig:
        await rig.stop()
        write(path, TWO.replace("id: 1,", "id: 7,"))
        await rig.reload()
        assert rig.stopped
        await rig.supervisors["arm"].tried.wait()
        with pytest.raises(EStopped):
            await rig["s1"].enable()


@virtual
async def test_one_at_a_time_and_to_its_end(path: Path) -> None:
    async with open_rig(path) as rig:
        await rig.enable()
        write(path, TWO.replace("id: 1,", "id: 7,"))
        first = asyncio.create_task(rig.reload(force=True))
        await asyncio.sleep(0)
        with pytest.raises(Busy, match="already"):
            await rig.reload()
        first.cancel()  # whoever asked may leave
        with pytest.raises(asyncio.CancelledError):
            await first
        await asyncio.sleep(3)
        assert rig.buses["arm"].driver.nodes == {"s1": 7}


@virtual
async def test_left_while_the_config_is_read_anew(path: Path) -> None:
    async with open_rig(path) as rig:
        await rig.enable()
        write(path, TWO.replace("id: 1,", "id: 7,"))
        reloading = asyncio.create_task(rig.reload(force=True))
        await asyncio.sleep(0)
    assert await reloading == Reload(changed=("arm",))
    assert {name: report.confirmed for name, report in rig.left.items()} == {"arm/s1": True, "leg/s2": True}


@virtual
async def test_only_the_buses_it_was_opened_with(path: Path) -> None:
    async with open_rig(path, buses=["arm"]) as rig:
        write(path, TWO.replace("id: 2", "id: 3"))
        assert await rig.reload() == Reload()
        assert list(rig.buses) == ["arm"]


@virtual
async def test_a_rig_without_a_file_says_so() -> None:
    async with open_rig(config()) as rig:
        with pytest.raises(NotSupported, match="not opened from a file"):
            await rig.reload()


@virtual
async def test_it_is_an_event(path: Path) -> None:
    async with open_rig(path) as rig:
        events = rig.events()
        event = asyncio.ensure_future(anext(events))
        await asyncio.sleep(0)
        await rig.reload()
        assert (await event).name == "reloaded"
        await events.aclose()
