"""The kinds of rig that a contract is tested with: one that owns its ports, and one of a daemon."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from pathlib import Path

import pytest

from servobus.config.loader import Config
from servobus.protocols.sms.simulated.device import SmsDevice
from servobus.remote.rig import connect
from servobus.rig.interface import Rig
from servobus.rig.local import LocalRig, open_rig
from tests.daemon_in_process import open_test_door
from tests.simulated_rigs import devices

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
