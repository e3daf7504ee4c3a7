"""The e-stop's latch survives a restart of the process that owns the ports."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from servobus.errors import EStopped
from servobus.rig.latch import LatchFile
from servobus.rig.local import open_rig
from tests.simulated_rigs import config
from tests.virtual_time import virtual
from tests.wire_log import WireLog


@virtual
async def test_a_latched_e_stop_survives_a_restart(tmp_path: Path) -> None:
    latch = LatchFile(tmp_path / "servobus.estop")
    async with open_rig(config(), latch=latch) as rig:
        await rig.enable()
        assert not latch.latched()
        stopping = asyncio.create_task(rig.stop())
        await asyncio.sleep(0)
        assert latch.latched(), "from the call on"
        await stopping
    async with open_rig(config(), latch=latch) as rig:
        assert rig.stopped
        with pytest.raises(EStopped, match="clear"):
            await rig.enable("s1")
        await rig.clear()
        await rig.enable("s1")
    async with open_rig(config(), latch=latch) as rig:
        assert not rig.stopped


@virtual
async def test_a_start_under_the_latch_energises_nothing(tmp_path: Path) -> None:
    latch = LatchFile(tmp_path / "servobus.estop")
    latch.set(latched=True)
    log = WireLog()
    async with open_rig(config("s1: {id: 1, model: sts}"), latch=latch, trace=log) as rig:
        assert (await rig.read("s1")).energised in (False, None)
    assert not [frame for frame in log.sent_frames if frame[4] in (3, 4, 0x83)], "a limp servo is not written to"


def test_a_latch_that_cannot_be_kept_hinders_no_stop(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    latch = LatchFile(tmp_path / "missing" / "servobus.estop")
    latch.set(latched=True)
    assert "latch_not_kept" in caplog.text
    assert not latch.latched()
