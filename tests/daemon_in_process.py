"""The native door of a rig in this process, for tests of what comes through it."""

from __future__ import annotations

import os
from contextlib import AbstractAsyncContextManager
from pathlib import Path

from servobus.daemon.server import HANDSHAKE, NativeDoor, open_door
from servobus.rig.local import LocalRig


def open_test_door(rig: LocalRig, path: Path, *, handshake: float = HANDSHAKE) -> AbstractAsyncContextManager[NativeDoor]:
    return open_door(rig, path, owner=os.geteuid(), handshake=handshake)
