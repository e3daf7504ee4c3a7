"""Device files of serial ports: whether a path is one, which process has it open, and why it cannot be opened."""

from __future__ import annotations

import errno
import grp
import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

from servobus.errors import LinkDown, PortBusy, PortDenied, PortMissing

PTY_MAJORS = range(136, 144)
KINDS = {stat.S_IFDIR: "a directory", stat.S_IFREG: "a regular file", stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}


def is_pty(path: str) -> bool:
    """Return whether the path is a pseudo terminal, which has no wire."""
    try:
        return os.major(os.stat(path).st_rdev) in PTY_MAJORS
    except OSError:
        return False


def check_device(path: str) -> None:
    """Check, without opening it, that a path can be a serial port. Raises PortMissing, PortDenied."""
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        raise PortMissing(f"{path} does not exist: plug the adapter in, or choose one that `servobus ports` shows") from None
    except OSError as error:
        raise explain_open_error(path, error) from None
    if not stat.S_ISCHR(mode):
        kind = KINDS.get(stat.S_IFMT(mode), "no character device")
        raise PortMissing(f"{path} is {kind}, not a serial port: choose one that `servobus ports` shows")


def explain_open_error(path: str, error: Exception) -> LinkDown:
    """Return an error that says what the system's error means and what to do."""
    code = _error_number(error)
    if code in REASONS:
        return REASONS[code](path)
    return LinkDown(f"{path} cannot be opened ({error}): unplug it and plug it in again, then try `servobus ports`")


def find_holder(path: str) -> tuple[int, str] | None:
    """Return process id and name of the program that has locked a device, else of one that has it open.

    Other processes are preferred to this one. None where there is none, or this user may not see it.
    """
    try:
        status = os.stat(path)
    except OSError:
        return None
    own = os.getpid()
    lockers = _locked_by(status)
    processes = [int(folder.name) for folder in Path("/proc").glob("[0-9]*")]
    for pid in sorted(processes, key=lambda pid: (pid not in lockers, pid == own, pid)):
        if any(os.path.samestat(status, other) for other in _open_files(pid)):
            return pid, _name(pid)
    return None


def _locked_by(status: os.stat_result) -> set[int]:
    """Return the processes that have locked this file. `1: FLOCK ADVISORY WRITE 4711 00:1c:3 0 EOF` names device and inode."""
    inode = f"{os.major(status.st_dev):02x}:{os.minor(status.st_dev):02x}:{status.st_ino}"
    try:
        lines = [line.split() for line in Path("/proc/locks").read_text().splitlines()]
    except OSError:
        return set()
    return {int(columns[-4]) for columns in lines if len(columns) >= 8 and columns[-3] == inode}


def _open_files(pid: int) -> Iterator[os.stat_result]:
    try:
        with os.scandir(f"/proc/{pid}/fd") as descriptors:
            for descriptor in descriptors:
                try:
                    yield descriptor.stat()
                except OSError:
                    continue  # closed meanwhile
    except OSError:
        return  # the process has ended, or belongs to another user


def _name(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/comm").read_text().strip()
    except OSError:
        return "ended meanwhile"


def _busy(path: str) -> LinkDown:
    holder = find_holder(path)
    if holder is None:
        return PortBusy(f"{path} is open in a process of another user: `sudo fuser -v {path}` names it; end it first")
    pid, name = holder
    if pid == os.getpid():
        return PortBusy(f"{path} is open already in this process ({pid}, {name}): close it there first")
    return PortBusy(f"{path} is open in process {pid} ({name}): end that first, or use the port through it")


def _denied(path: str) -> LinkDown:
    """If the device's group may open it, tell the user to join the group; otherwise suggest a udev rule."""
    try:
        status = os.stat(path)
        shared = status.st_gid != 0 and status.st_mode & 0o060 == 0o060
        group = grp.getgrgid(status.st_gid).gr_name
    except (OSError, KeyError):
        shared, group = False, "another group"
    if shared:
        return PortDenied(
            f"{path} belongs to group {group}, which you are not in: `sudo usermod -aG {group} $USER`, then log in again"
        )
    advice = "give it to group dialout by a udev rule, `sudo usermod -aG dialout $USER`, then log in again"
    return PortDenied(f"{path} may not be opened by you, nor by its group ({group}): {advice}")


def _not_permitted(path: str) -> LinkDown:
    """The file's permissions allow it, but the device rules of a container or service do not."""
    advice = f"start the container with `--device {path}`, or the service with `DeviceAllow={path}`"
    return PortDenied(f"{path} is not passed to this container or service: {advice}")


def _gone(path: str) -> LinkDown:
    return PortMissing(f"{path} has no device behind it: plug the adapter in again")


def _no_port(path: str) -> LinkDown:
    return PortMissing(f"{path} is a device, but not a serial port: choose one that `servobus ports` shows")


REASONS: dict[int, Callable[[str], LinkDown]] = {
    errno.EACCES: _denied,
    errno.EPERM: _not_permitted,
    errno.EBUSY: _busy,
    errno.EAGAIN: _busy,  # pyserial's lock
    errno.ENOENT: _gone,
    errno.ENXIO: _gone,
    errno.ENODEV: _gone,
    errno.EIO: _gone,  # the kernel has the port, but there is no hardware
    errno.ENOTTY: _no_port,
    errno.EINVAL: _no_port,
}


def _error_number(error: BaseException | None) -> int:
    """Return the system's error number. Some errors of pyserial wrap it, and those of termios keep it in `args`."""
    while error is not None:
        number = getattr(error, "errno", None) or next(iter(error.args), None)
        if isinstance(number, int):
            return number
        error = error.__context__
    return 0
