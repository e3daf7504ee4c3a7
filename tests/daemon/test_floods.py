"""More connections than there can be: the buses go on, who is in is served, and afterwards everybody is."""

from __future__ import annotations

import json
import os
import resource
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from tests.cli.processes import servobus, until
from tests.config.mistakes import GOOD

pytestmark = pytest.mark.slow

DESCRIPTORS = 64
"""What the daemon may open; a few are its own."""
OWN = 2
"""The loop may keep as many back."""
LIMITS = "version: 1\ndoor: {clients_per_user: 1000}"


@contextmanager
def connected(path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX) as client:
        client.settimeout(20)
        client.connect(str(path))
        yield client


def polls(client: socket.socket) -> int | None:
    """What the bus has polled so far, as the daemon answers; None: it hangs up."""
    try:
        client.sendall(b'{"jsonrpc":"2.0","id":1,"method":"stats"}\n')
        received = b""
        while not received.endswith(b"\n"):
            piece = client.recv(65536)
            if not piece:
                return None
            received += piece
    except ConnectionError:
        return None
    counts: int = json.loads(received)["result"]["arm"].get("polled", 0)
    return counts


def used(pid: int) -> int:
    return len(os.listdir(f"/proc/{pid}/fd"))


def test_a_daemon_without_a_descriptor_left_goes_on_and_recovers(tmp_path: Path) -> None:
    config, path = tmp_path / "rig.yaml", tmp_path / "s" / "servobus.sock"
    config.write_text(GOOD.replace("version: 1", LIMITS))
    with servobus("run", str(config), SERVOBUS_SOCKET=str(path)) as daemon:
        until(daemon, "running")
        resource.prlimit(daemon.pid, resource.RLIMIT_NOFILE, (DESCRIPTORS, DESCRIPTORS))
        with ExitStack() as stack:
            inside = stack.enter_context(connected(path))
            before = polls(inside)
            assert before is not None
            outside = [stack.enter_context(connected(path)) for _ in range(2 * DESCRIPTORS)]
            served = [client for client in outside[: DESCRIPTORS // 4] if polls(client) is not None]
            assert len(served) == DESCRIPTORS // 4
            while (now := polls(inside)) is not None and now < before + 50:
                os.sched_yield()
            assert now is not None
            assert used(daemon.pid) >= DESCRIPTORS - OWN, "there is none left, or as good as none"
        # What was hung up is looked through first; then everybody is served again.
        for _ in range(1000):
            with connected(path) as client:
                if polls(client) is not None:
                    break
        else:
            raise AssertionError("nobody comes in any more")
        daemon.terminate()
        assert daemon.wait(10) == 0
