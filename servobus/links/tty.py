"""What the system says of a device file: whether it is a port, who holds it, and why it cannot be opened."""

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
    """A terminal without a wire."""
    try:
        return os.major(os.stat(path).st_rdev) in PTY_MAJORS
    except OSError:
        return False


def check_device(path: str) -> None:
    """Raises PortMissing for what can be no serial port, PortDenied for what cannot even be looked at; opens nothing."""
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        raise PortMissing(f"{path} does not exist: plug the adapter in, or choose one that `servobus ports` shows") from None
    except OSError as error:
        raise explain(path, error) from None
    if not stat.S_ISCHR(mode):
        kind = KINDS.get(stat.S_IFMT(mode), "no character device")
        raise PortMissing(f"{path} is {kind} and no serial port: choose one that `servobus ports` shows")


def explain(path: str, error: Exception) -> LinkDown:
    """What the system's error means, and what to do about it."""
    code = _code(error)
    if code in REASONS:
        return REASONS[code](path)
    return LinkDown(f"{path} cannot be opened ({error}): unplug it and plug it in again, then try `servobus ports`")


def find_holder(path: str) -> tuple[int, str] | None:
    """The process that has locked this device, or else has it open, and its name, as far as this user may see; another one rather
    than this one."""
    try:
        wanted = os.stat(path)
    except OSError:
        return None
    own = os.getpid()
    locked = _locked_by(wanted)
    processes = [int(folder.name) for folder in Path("/proc").glob("[0-9]*")]
    for pid in sorted(processes, key=lambda pid: (pid not in locked, pid == own, pid)):
        if any(os.path.samestat(wanted, found) for found in _open_files(pid)):
            return pid, _name(pid)
    return None


def _locked_by(wanted: os.stat_result) -> set[int]:
    """Processes with a lock on this file: `1: FLOCK ADVISORY WRITE 4711 00:1c:3 0 EOF` names device and inode."""
    place = f"{os.major(wanted.st_dev):02x}:{os.minor(wanted.st_dev):02x}:{wanted.st_ino}"
    try:
        lines = [line.split() for line in Path("/proc/locks").read_text().splitlines()]
    except OSError:
        return set()
    return {int(words[-4]) for words in lines if len(words) >= 8 and words[-3] == place}


def _open_files(pid: int) -> Iterator[os.stat_result]:
    try:
        with os.scandir(f"/proc/{pid}/fd") as descriptors:
            for descriptor in descriptors:
                try:
                    yield descriptor.stat()
                except OSError:
                    continue  # closed meanwhile
    except OSError:
        return  # ended meanwhile, or another user's


def _name(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/comm").read_text().strip()
    except OSError:
        return "ended meanwhile"


def _busy(path: str) -> LinkDown:
    holder = find_holder(path)
    if holder is None:
        return PortBusy(f"{path} is held by a process of another user: `sudo fuser -v {path}` names it; end it first")
    pid, name = holder
    if pid == os.getpid():
        return PortBusy(f"{path} is open already in this process ({pid}, {name}): close it there first")
    return PortBusy(f"{path} is held by process {pid} ({name}): end that first, or let it do the work")


def _denied(path: str) -> LinkDown:
    """A group that may is joined; where there is none, or it is root's, a rule has to make one."""
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


def _walled_off(path: str) -> LinkDown:
    """The file's own permissions do not say this, but the walls around a container or a service do."""
    advice = f"start the container with `--device {path}`, or the service with `DeviceAllow={path}`"
    return PortDenied(f"{path} is kept from this container or service: {advice}")


def _gone(path: str) -> LinkDown:
    return PortMissing(f"{path} has no device behind it: plug the adapter in again")


def _no_port(path: str) -> LinkDown:
    return PortMissing(f"{path} is a device, but no serial port: choose one that `servobus ports` shows")


REASONS: dict[int, Callable[[str], LinkDown]] = {
    errno.EACCES: _denied,
    errno.EPERM: _walled_off,
    errno.EBUSY: _busy,
    errno.EAGAIN: _busy,  # pyserial's lock
    errno.ENOENT: _gone,
    errno.ENXIO: _gone,
    errno.ENODEV: _gone,
    errno.EIO: _gone,  # a port that the kernel knows, and no hardware
    errno.ENOTTY: _no_port,
    errno.EINVAL: _no_port,
}


def _code(error: BaseException | None) -> int:
    """The system's error number. pyserial wraps some errors without it, and those of termios have no name for it."""
    while error is not None:
        number = getattr(error, "errno", None) or next(iter(error.args), None)
        if isinstance(number, int):
            return number
        error = error.__context__
    return 0
