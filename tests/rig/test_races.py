"""Two things at once: whatever the order, nothing moves or stays energised that somebody wanted at rest."""

from __future__ import annotations

import asyncio
from contextlib import suppress

import pytest

from servobus.errors import Busy, EStopped, InvalidRequest, NotEnabled, ServobusError
from servobus.rig.local import LocalRig, open_rig
from tests.simulated_rigs import config, devices
from tests.virtual_time import virtual

LIMP = "s1: {id: 1, model: sts, on_estop: limp, on_exit: limp}"


def torque(rig: LocalRig, node: int = 1) -> int:
    return devices(rig)[node].get("torque_enable")


async def stream(rig: LocalRig) -> None:
    """A caller that never gives up."""
    position = 0.0
    while True:
        position = 10.0 - position
        with suppress(ServobusError):
            await rig["s1"].move_to(position)
        await asyncio.sleep(0.0003)


@pytest.mark.parametrize("ending", ["exit", "stop"])
@virtual
async def test_goals_that_stream_in_do_not_energise_what_is_left_limp(ending: str) -> None:
    async with open_rig(config(LIMP)) as rig:
        await rig.enable()
        streaming = asyncio.create_task(stream(rig))
        await asyncio.sleep(0.1)
        if ending == "stop":
            await rig.stop()
            await asyncio.sleep(0.1)
            assert torque(rig) == 0
    await asyncio.sleep(0)
    streaming.cancel()
    assert torque(rig) == 0


@virtual
async def test_a_stop_whose_caller_leaves_is_done_all_the_same() -> None:
    async with open_rig(config(LIMP)) as rig:
        await rig.enable()
        stopping = asyncio.create_task(rig.stop())
        await asyncio.sleep(0)
        stopping.cancel()
        with pytest.raises(asyncio.CancelledError):
            await stopping
        with pytest.raises(Busy, match="still being stopped"):
            await rig.clear()
        await asyncio.sleep(1)
        assert torque(rig) == 0
        await rig.clear()
        with pytest.raises(NotEnabled):
            await rig["s1"].move_to(5)


@virtual
async def test_enable_and_disable_at_once_end_disabled() -> None:
    async with open_rig(config(LIMP)) as rig:
        await asyncio.gather(rig.enable(), rig.disable(), return_exceptions=True)
        assert torque(rig) == 0
        with pytest.raises(NotEnabled):
            await rig["s1"].move_to(5)


@virtual
async def test_an_e_stop_before_an_unknown_servo_is_enabled() -> None:
    async with open_rig(config("s1: {id: 1, model: sts}")) as rig:
        rig.buses["arm"].records["s1"].identity = None
        enabling = asyncio.create_task(rig.enable())
        await asyncio.sleep(0.001)
        await rig.stop()
        with pytest.raises(EStopped):
            await enabling
        assert torque(rig) == 0


@virtual
async def test_the_end_does_not_park_what_the_e_stop_holds() -> None:
    async with open_rig(config("s1: {id: 1, model: sts, on_exit: park, park_pose: 60}")) as rig:
        await rig.enable()
        await rig.stop()
        device = devices(rig)[1]
    assert device.joint.position == pytest.approx(2048, abs=1)


@virtual
async def test_one_that_restarted_unseen_is_not_parked() -> None:
    async with open_rig(config("s1: {id: 1, model: sts, on_exit: park, park_pose: 60}")) as rig:
        await rig.enable()
        device = devices(rig)[1]
        device.reboot(asyncio.get_running_loop().time())
        await asyncio.sleep(2)
    assert (device.get("torque_enable"), round(device.joint.position)) == (0, 2048)


@virtual
async def test_no_session_while_something_is_being_enabled() -> None:
    async with open_rig(config("s1: {id: 1, model: sts}")) as rig:
        enabling = asyncio.create_task(rig.enable())
        await asyncio.sleep(0.001)
        with pytest.raises(Busy, match="s1"):
            await rig.scan("arm", ids=[1])
        await enabling


@virtual
async def test_an_e_stop_reaches_a_line_that_was_down_when_it_is_back() -> None:
    async with open_rig(config(LIMP)) as rig:
        await rig.enable()
        link = rig.supervisors["arm"].link
        link.unplug()  # type: ignore[attr-defined]
        await asyncio.sleep(0.01)
        assert rig.snapshot()["arm/s1"].health != "online"
        reports = await rig.stop()
        assert not reports["arm/s1"].written
        link.plug()  # type: ignore[attr-defined]
        await asyncio.sleep(1)
        assert torque(rig) == 0


@virtual
async def test_settle_ends_when_the_goal_cannot_be_reached_any_more() -> None:
    async with open_rig(config("s1: {id: 1, model: sts}")) as rig:
        await rig.enable()
        await rig["s1"].move_to(80)
        settling = asyncio.create_task(rig["s1"].settle())
        await asyncio.sleep(0.05)
        await rig.stop()
        with pytest.raises(EStopped, match="before the servo arrived at its goal"):
            await settling


@virtual
async def test_a_cancelled_exit_is_done_all_the_same() -> None:
    async def main() -> LocalRig:
        async with open_rig(config("s1: {id: 1, model: sts, on_exit: park, park_pose: 30}")) as rig:
            await rig.enable()
            started.set_result(rig)
        return rig

    started: asyncio.Future[LocalRig] = asyncio.get_running_loop().create_future()
    task = asyncio.create_task(main())
    rig = await started
    await asyncio.sleep(0.01)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert torque(rig) == 0
    assert devices(rig)[1].joint.position == pytest.approx(2048 + 30 / 360 * 4096, abs=10)


@virtual
async def test_one_servo_under_two_names() -> None:
    async with open_rig(config(LIMP)) as rig:
        await rig.enable()
        with pytest.raises(InvalidRequest, match="named twice"):
            await rig.move({"s1": 10, "arm/s1": 20})


@virtual
async def test_a_duration_does_not_exceed_max_speed() -> None:
    async with open_rig(config("s1: {id: 1, model: sts, max_speed: 90}")) as rig:
        await rig.enable()
        await rig["s1"].move_to(80)
        await rig["s1"].move_to(0.0, duration=1.0)
        assert devices(rig)[1].get("goal_speed") <= 1024
