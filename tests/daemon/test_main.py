"""The daemon's main: what a signal does while it starts."""

from __future__ import annotations

import asyncio
import os
import signal
from contextlib import suppress
from pathlib import Path

from servobus.daemon.main import serve_rig
from tests.cli.processes import LIMP
from tests.daemon.raw_client import Raw
from tests.waiting import until


async def test_a_reload_that_is_asked_for_while_the_daemon_starts(tmp_path: Path) -> None:
    """SIGHUP at any moment after the first step of `serve_rig` ends nothing, and the config is read again."""
    config, path = tmp_path / "rig.yaml", tmp_path / "servobus.sock"
    config.write_text(LIMP)
    daemon = asyncio.create_task(serve_rig(str(config), path, 60.0))
    await asyncio.sleep(0)
    assert signal.getsignal(signal.SIGHUP) is not signal.SIG_DFL
    config.write_text(LIMP.replace("id: 1,", "id: 9,"))
    os.kill(os.getpid(), signal.SIGHUP)
    try:
        await until(path.is_socket)
        raw = Raw(*await asyncio.open_unix_connection(str(path)))
        for _ in range(10_000):
            if (await raw.call("config"))["buses"]["arm"]["servos"]["shoulder"]["id"] == 9:
                break
        else:
            raise AssertionError("the config was not read again")
        assert not daemon.done()
        await raw.close()
    finally:
        daemon.cancel()
        with suppress(asyncio.CancelledError):
            await daemon
