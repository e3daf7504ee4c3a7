"""A change of id on a rig: what becomes of it when the servo is switched off and on."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import cast

import pytest

from servobus.errors import NotSupported
from servobus.protocols.kst.simulated.device import KstDevice
from servobus.rig.local import LocalRig, open_rig
from servobus.simulation.link import SimulatedLink
from servobus.values import Health
from tests.simulated_rigs import config
from tests.virtual_time import virtual
from tests.waiting import until


@asynccontextmanager
async def gimbal() -> AsyncIterator[tuple[LocalRig, KstDevice]]:
    """A rig with one KST servo, `pan`, and its device."""
    setup = config("pan: {id: 1}", protocol="kst", baudrate=512000, poll="{feedback: 20, health: 5}")
    async with open_rig(setup) as rig:
        (device,) = cast("SimulatedLink", rig.supervisors["arm"].link).line.devices
        assert isinstance(device, KstDevice)
        await until(lambda: rig.state("pan").health is Health.ONLINE)
        yield rig, device


async def power_cycle(rig: LocalRig, device: KstDevice) -> None:
    """Off until the bus has noticed it, then on."""
    device.dead = True
    await until(lambda: rig.state("pan").health is Health.OFFLINE)
    device.reboot(asyncio.get_running_loop().time())
    device.dead = False


def faults(rig: LocalRig) -> tuple[str, ...]:
    return rig.state("pan").faults


@virtual
async def test_an_unsaved_id_is_lost_by_a_power_cycle_and_can_be_set_again() -> None:
    async with gimbal() as (rig, device):
        change = await rig.set_id("arm", 1, 7)
        assert (change.saved, change.pending_reboot) == (False, True)
        assert "pending_reboot" in faults(rig)
        with pytest.raises(NotSupported, match="One change at a time"):
            await rig.set_id("arm", 1, 8)
        await power_cycle(rig, device)
        await until(lambda: "pending_reboot" not in faults(rig))
        assert rig.state("pan").health is Health.ONLINE
        change = await rig.set_id("arm", 1, 8)
        assert (change.value, change.pending_reboot) == (8, True)


@virtual
async def test_a_saved_id_answers_after_a_power_cycle() -> None:
    async with gimbal() as (rig, device):
        assert (await rig.set_id("arm", 1, 7, save=True)).saved
        await power_cycle(rig, device)
        assert device.node == 7
        await until(lambda: "pending_reboot" not in faults(rig))
        assert rig.state("pan").health is Health.OFFLINE, "the config still has its old id"
        hits = await rig.scan("arm", ids=range(1, 10))
        assert [hit.id for hit in hits] == [7]
