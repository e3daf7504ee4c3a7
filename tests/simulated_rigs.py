"""Rigs on simulated lines, in memory or behind a PTY, for tests of everything above the protocols."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, closing
from pathlib import Path
from typing import Any, cast

from servobus.config.loader import Config, parse_config
from servobus.protocols.sms.simulated.device import SmsDevice
from servobus.rig.local import LocalRig, open_rig
from servobus.simulation.link import SimulatedLink, far_end, simulated_line
from servobus.simulation.pty import SimulatedPty

STS = {
    1: "s1: {id: 1, model: sts, limits: [-90, 90]}",
    2: "s2: {id: 2, model: sts}",
    3: "s3: {id: 3, model: sts, on_estop: limp}",
}


def config(*servos: str, port: str = "sim:", **keys: Any) -> Config:
    """Return a config with a bus `arm` at 1 Mbaud. `servos`: lines of YAML; `keys`: more keys of the bus, in YAML flow style."""
    lines = [
        f"    {key}: {value}" for key, value in {"protocol": "sms", "port": f"{port!r}", "baudrate": 1000000, **keys}.items()
    ]
    servo_lines = [f"      {servo}" for servo in servos or STS.values()]
    return parse_config("\n".join(["version: 1", "buses:", "  arm:", *lines, "    servos:", *servo_lines, ""]), "test", Path())


def devices(rig: LocalRig, bus: str = "arm") -> dict[int, SmsDevice]:
    """The simulated servos of a bus in memory, by id."""
    link = cast("SimulatedLink", rig.supervisors[bus].link)
    return {device.node: cast("SmsDevice", device) for device in link.line.devices}


@asynccontextmanager
async def pty_rig(setup: Config, **options: Any) -> AsyncIterator[LocalRig]:
    """The same bus, but served behind a PTY; the rig opens that like any port."""
    loop = asyncio.get_running_loop()
    simulated, models = setup.buses["arm"], setup.models["arm"]
    with (
        closing(simulated_line(simulated, models, loop)) as line,
        closing(SimulatedPty(far_end(simulated, line, loop), loop)) as pty,
    ):
        real = simulated.model_copy(update={"port": pty.path, "faults": None})
        async with open_rig(Config(version=1, buses={"arm": real}, models=setup.models), **options) as rig:
            yield rig
