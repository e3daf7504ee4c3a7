"""What tests of a client need: time that passes, and the error that kept it out."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

from servobus.errors import ServobusError
from servobus.remote.rig import connect
from tests.scripted_daemon import STATE, PuppetDaemon

LEASE = 0.3
ACKED = {"result": {"arm/s1": "acked"}}


async def until(condition: Any) -> None:
    """In virtual time, which leaps: ten seconds of it."""
    for _ in range(10_000):
        if condition():
            return
        await asyncio.sleep(0.001)
    raise AssertionError("it never came to be")


async def alive(daemon: PuppetDaemon, seconds: float) -> None:
    """Let time pass, with a daemon that says something now and then."""
    for _ in range(int(seconds * 10)):
        await asyncio.sleep(0.1)
        daemon.visitor.notify("state", stopped=False, states={"arm/s1": STATE, "arm/s2": STATE})


async def refused(path: Path, **options: Any) -> ServobusError:
    with pytest.raises(ServobusError) as caught:
        async with connect(path, **options):
            pass
    return caught.value
