"""Simulated buses for other programs: a PTY for each bus, or an arm on a TCP port. `servobus sim` runs it.

The `port` of a bus only decides whether its hands are behind a RealMan arm. Bytes take their time at the rate that the PTY's user
set, and a servo receives only bytes at its own rate.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from contextlib import AsyncExitStack, closing
from pathlib import Path

import anyio

from servobus.protocols.model import ServoModel
from servobus.protocols.options import BusOptions
from servobus.simulation.arm_server import address, arm_server, is_arm
from servobus.simulation.link import far_end, simulated_line
from servobus.simulation.pty import SimulatedPty


async def serve(
    buses: Mapping[str, BusOptions],
    models: Mapping[str, Mapping[str, ServoModel]],
    announce: Callable[[str, str], None],
    *,
    folder: Path | None = None,
) -> None:
    """Serve simulated buses until cancelled.

    Args:
        buses: options of each bus, by bus name.
        models: models of each bus, by bus name.
        announce: is called with the name and the path of each bus, once all can be opened.
        folder: makes a symlink there for each PTY, with the name of its bus. Files in it are not replaced.

    Raises FileExistsError, OSError.
    """
    loop = asyncio.get_running_loop()
    async with AsyncExitStack() as stack:
        paths = {}
        for name, options in buses.items():
            if is_arm(options.port):
                server = await stack.enter_async_context(arm_server(options, models[name]))
                paths[name] = address(options, server)
                continue
            line = stack.enter_context(closing(simulated_line(options, models[name], loop)))
            symlink = folder / name if folder else None
            far = far_end(options, line, loop)
            paths[name] = stack.enter_context(closing(SimulatedPty(far, loop, backlog=line.backlog, symlink=symlink))).path
        for name, path in paths.items():
            announce(name, path)
        await anyio.sleep_forever()
