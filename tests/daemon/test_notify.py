"""What systemd hears, at the other end of its socket."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from servobus.daemon.notify import Notifier


@pytest.fixture
def system(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as listener:
        listener.bind(str(tmp_path / "notify"))
        yield listener


def test_each_word(system: socket.socket) -> None:
    notifier = Notifier({"NOTIFY_SOCKET": system.getsockname()})
    notifier.ready("2 buses")
    notifier.alive()
    notifier.reloading()
    notifier.stopping()
    assert system.recv(999) == b"READY=1\nSTATUS=2 buses"
    assert system.recv(999) == b"WATCHDOG=1"
    assert system.recv(999).startswith(b"RELOADING=1\nMONOTONIC_USEC=")
    assert system.recv(999) == b"STOPPING=1"


def test_an_abstract_socket() -> None:
    name = f"servobus-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as listener:
        listener.bind("\0" + name)
        Notifier({"NOTIFY_SOCKET": "@" + name}).alive()
        assert listener.recv(99) == b"WATCHDOG=1"


def test_nobody_listens(tmp_path: Path) -> None:
    Notifier({}).alive()
    Notifier({"NOTIFY_SOCKET": str(tmp_path / "gone")}).alive()


@pytest.mark.parametrize(
    ("environ", "seconds"),
    [
        ({}, None),
        ({"WATCHDOG_USEC": "5000000"}, 5.0),
        ({"WATCHDOG_USEC": "5000000", "WATCHDOG_PID": str(os.getpid())}, 5.0),
        ({"WATCHDOG_USEC": "5000000", "WATCHDOG_PID": "1"}, None),
        ({"WATCHDOG_USEC": "0"}, None),
        ({"WATCHDOG_USEC": "soon"}, None),
    ],
)
def test_how_often_it_wants_to_hear(environ: dict[str, str], seconds: float | None) -> None:
    assert Notifier(environ).watchdog == seconds
