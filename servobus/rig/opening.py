"""How a program comes by a rig of its own: `servobus.open`."""

from __future__ import annotations

from collections.abc import AsyncIterator, Collection
from contextlib import asynccontextmanager
from pathlib import Path

import anyio

from servobus.config.loader import Config, load_config
from servobus.rig.local import LocalRig
from servobus.rig.results import uncancelled
from servobus.rig.supervisor import Trace


@asynccontextmanager
async def open_rig(
    config: str | Path | Config, *, buses: Collection[str] = (), degraded: bool = False, trace: Trace | None = None
) -> AsyncIterator[LocalRig]:
    """This process owns the ports of `config` (a path, or a loaded Config) until the context ends; then each servo enabled here
    is left as its `on_exit` says. `buses`: only these. `degraded`: ports that cannot be opened are waited for instead of raising.
    `trace` is called with every piece of bytes on the wire, both ways.
    Raises ConfigError, PortMissing, PortBusy, PortDenied, LinkDown."""
    path = None if isinstance(config, Config) else Path(config)
    setup = config if isinstance(config, Config) else load_config(config)
    failure: BaseException | None = None
    async with anyio.create_task_group() as supervisors:
        rig = LocalRig(setup, supervisors, buses, trace, path)
        try:
            await rig.start(degraded=degraded)
            yield rig
        except BaseException as error:  # noqa: BLE001 - raised again below, outside the group, which would wrap it
            failure = error
        cancelled = await uncancelled(rig.leave())
        supervisors.cancel_scope.cancel()
    cancelled = await uncancelled(rig.close()) or cancelled
    if failure or cancelled:
        raise failure or cancelled  # type: ignore[misc]
