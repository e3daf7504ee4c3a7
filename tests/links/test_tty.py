"""Why a port cannot be opened: each error says which port, why, and what to do."""

from __future__ import annotations

import errno
import os
import re
import socket
import subprocess
import sys
import termios
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import serial

from servobus.errors import LinkDown, PortBusy, PortDenied, PortMissing
from servobus.links.serial import SerialLink
from servobus.links.tty import check_device, explain_open_error, find_holder, is_pty
from tests.links.bare_pty import plugged
from tests.links.recorder import Receiver

HOLD = """
import serial, sys
port = serial.Serial(sys.argv[1], exclusive=True)
print("held", flush=True)
sys.stdin.read()
"""


@contextmanager
def held(path: str) -> Iterator[tuple[int, str]]:
    """Another process has the port open: its pid and name."""
    with subprocess.Popen([sys.executable, "-c", HOLD, path], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stdout.readline() == b"held\n"
        yield process.pid, Path(f"/proc/{process.pid}/comm").read_text().strip()
        process.stdin.close()


async def connecting(path: str) -> LinkDown:
    """Return the error of connecting."""
    receiver = Receiver()
    with pytest.raises(LinkDown) as caught:
        await SerialLink(path, 115_200).connect(receiver)
    assert (receiver.made, receiver.lost) == (0, [])
    return caught.value


async def test_missing(tmp_path: Path) -> None:
    error = await connecting(str(tmp_path / "ttyUSB7"))
    assert isinstance(error, PortMissing)
    assert str(error) == f"{tmp_path}/ttyUSB7 does not exist: plug the adapter in, or choose one that `servobus ports` shows"


async def test_a_link_that_leads_nowhere(tmp_path: Path) -> None:
    """As udev's do for a moment."""
    (tmp_path / "arm").symlink_to("ttyUSB7")
    assert isinstance(await connecting(str(tmp_path / "arm")), PortMissing)


async def test_a_file(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("keep me")
    error = await connecting(str(path))
    assert isinstance(error, PortMissing)
    assert str(error) == f"{path} is a regular file, not a serial port: choose one that `servobus ports` shows"
    assert path.read_text() == "keep me"


def test_other_things_that_are_no_port(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "socket"))
        for path, kind in ((tmp_path, "a directory"), (tmp_path / "pipe", "a pipe"), (tmp_path / "socket", "a socket")):
            with pytest.raises(PortMissing, match=f"{re.escape(str(path))} is {kind}, not a serial port"):
                check_device(str(path))


async def test_a_device_that_is_no_port() -> None:
    error = await connecting("/dev/null")
    assert isinstance(error, PortMissing)
    assert str(error) == "/dev/null is a device, but not a serial port: choose one that `servobus ports` shows"


async def test_a_path_through_a_file(tmp_path: Path) -> None:
    """An error without a text of ours keeps the system's."""
    (tmp_path / "file").touch()
    error = await connecting(str(tmp_path / "file" / "ttyUSB0"))
    assert type(error) is LinkDown
    assert "Not a directory" in str(error)
    assert "servobus ports" in str(error)


async def test_busy() -> None:
    """The holder has a number and a name, and when it is gone the port is free."""
    with plugged() as pty:
        with held(pty.path) as (pid, name):
            error = await connecting(pty.path)
            assert find_holder(pty.path) == (pid, name)
        assert isinstance(error, PortBusy)
        assert str(error) == f"{pty.path} is open in process {pid} ({name}): end that first, or use the port through it"
        (await SerialLink(pty.path, 115_200).connect(Receiver())).abort()


async def test_busy_here() -> None:
    with plugged() as pty:
        transport = await SerialLink(pty.path, 115_200).connect(Receiver())
        error = await connecting(pty.path)
        transport.abort()
    assert isinstance(error, PortBusy)
    assert f"open already in this process ({os.getpid()}, " in str(error)
    assert str(error).endswith("close it there first")


def test_a_busy_port_without_a_visible_holder(tmp_path: Path) -> None:
    """A user who cannot see another user's processes is told a command that can."""
    error = explain_open_error(str(tmp_path), OSError(errno.EBUSY, "Device or resource busy"))
    assert isinstance(error, PortBusy)
    assert f"`sudo fuser -v {tmp_path}`" in str(error)


def test_nobody_holds_what_is_not_there(tmp_path: Path) -> None:
    assert find_holder(str(tmp_path / "ttyUSB7")) is None


@contextmanager
def not_as_root() -> Iterator[None]:
    """Nothing is denied to root, so root becomes somebody else."""
    user = os.geteuid()
    os.seteuid(user or 65_534)
    try:
        yield
    finally:
        os.seteuid(user)


async def test_denied(tmp_path: Path) -> None:
    (tmp_path / "locked").mkdir(mode=0)
    with not_as_root():
        error = await connecting(str(tmp_path / "locked" / "ttyUSB0"))
    assert isinstance(error, PortDenied)


def test_denied_to_those_outside_the_group(tmp_path: Path) -> None:
    """The group that owns the port is named."""
    port = tmp_path / "ttyUSB0"
    port.touch()
    port.chmod(0o660)
    if os.geteuid() == 0:
        os.chown(port, -1, 1)
    error = explain_open_error(str(port), PermissionError(errno.EACCES, "Permission denied"))
    group = port.group()
    assert isinstance(error, PortDenied)
    assert str(error) == (
        f"{port} belongs to group {group}, which you are not in: `sudo usermod -aG {group} $USER`, then log in again"
    )


def test_denied_to_everybody(tmp_path: Path) -> None:
    """The message does not suggest a group that would not help."""
    port = tmp_path / "ttyUSB0"
    port.touch()
    port.chmod(0o600)
    error = explain_open_error(str(port), PermissionError(errno.EACCES, "Permission denied"))
    assert isinstance(error, PortDenied)
    assert f"nor by its group ({port.group()}): give it to group dialout by a udev rule" in str(error)
    unseen = explain_open_error(str(tmp_path / "gone"), PermissionError(errno.EACCES, "Permission denied"))
    assert isinstance(unseen, PortDenied)
    assert "nor by its group (another group)" in str(unseen)


@pytest.mark.parametrize(
    ("error", "kind", "text"),
    [
        (
            serial.SerialException(errno.ENOENT, "could not open port"),
            PortMissing,
            "no device behind it: plug the adapter in again",
        ),
        (OSError(errno.ENODEV, "No such device"), PortMissing, "no device behind it"),
        (OSError(errno.ENXIO, "No such device or address"), PortMissing, "no device behind it"),
        (termios.error(errno.EIO, "Input/output error"), PortMissing, "no device behind it"),
        (OSError(errno.EPERM, "Operation not permitted"), PortDenied, "start the container with `--device /dev/ttyUSB7`, or"),
        (OSError(errno.EINVAL, "Invalid argument"), PortMissing, "not a serial port"),
        (serial.SerialException(errno.EWOULDBLOCK, "Could not exclusively lock port"), PortBusy, "is open in"),
        (ValueError("Invalid baud rate: -1"), LinkDown, "cannot be opened (Invalid baud rate: -1): unplug it"),
    ],
)
def test_what_the_system_may_say(error: Exception, kind: type[LinkDown], text: str) -> None:
    link_down = explain_open_error("/dev/ttyUSB7", error)
    assert type(link_down) is kind
    assert str(link_down).startswith("/dev/ttyUSB7 ")
    assert text in str(link_down)


def test_what_is_a_pty(tmp_path: Path) -> None:
    with plugged() as pty:
        (tmp_path / "arm").symlink_to(pty.path)
        assert is_pty(pty.path)
        assert is_pty(str(tmp_path / "arm"))
    assert not is_pty("/dev/null")
    assert not is_pty(str(tmp_path / "gone"))
