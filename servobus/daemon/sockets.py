"""The sockets of the native door: a path that is ours alone, who is at the other end, and on TCP a token before a word."""

from __future__ import annotations

import grp
import hashlib
import hmac
import os
import socket
import ssl
import stat
import struct
from collections import deque
from contextlib import suppress
from pathlib import Path

from servobus.config.access import TcpOptions
from servobus.errors import AccessDenied, ConfigError, Overloaded, PortBusy

GROUP = "servobus"
"""Its members may open the socket, where the system has such a group."""
FOLDER_MODE, SOCKET_UMASK = 0o750, 0o117
CREDENTIALS = struct.Struct("3i")
MIN_TOKEN = 32
TRIES, WINDOW = 5, 60.0
"""Wrong tokens of one address in so many seconds; then it waits that long."""
BACKLOG = 1024
MAX_PATH = 107
"""Bytes of a socket's path: sun_path of Linux, less its final zero."""


def peer_credentials(sock: socket.socket) -> tuple[int, int, int]:
    """Process, user and group at the other end of a Unix socket, as the system knows them."""
    pid, uid, gid = CREDENTIALS.unpack(sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, CREDENTIALS.size))
    return pid, uid, gid


def claim(path: Path) -> socket.socket:
    """Listen there. Raises PortBusy where a daemon does already, ConfigError where the place is not safe or its path too long."""
    if len(os.fsencode(path)) > MAX_PATH:
        raise ConfigError(f"{path} has more than {MAX_PATH} bytes, too many for a socket: set SERVOBUS_SOCKET to a shorter path")
    _make_folder(path.parent)
    _remove_stale(path)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
    before = os.umask(SOCKET_UMASK)  # the file never exists with another mode
    try:
        listener.bind(str(path))
    except OSError as error:
        listener.close()
        raise ConfigError(f"{path} cannot be made ({error.strerror}): set SERVOBUS_SOCKET to another place") from None
    finally:
        os.umask(before)
    with suppress(KeyError, PermissionError):
        os.chown(path, -1, grp.getgrnam(GROUP).gr_gid)
    listener.listen(BACKLOG)
    return listener


def _make_folder(folder: Path) -> None:
    with suppress(FileExistsError):
        folder.mkdir(mode=FOLDER_MODE, parents=True)
        with suppress(KeyError, PermissionError):
            os.chown(folder, -1, grp.getgrnam(GROUP).gr_gid)
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode):
        raise ConfigError(f"{folder} is no folder: remove it, or set SERVOBUS_SOCKET to another place")
    if found.st_uid not in (0, os.geteuid()):
        raise ConfigError(f"{folder} belongs to somebody else (uid {found.st_uid}): set SERVOBUS_SOCKET to another place")
    if found.st_mode & stat.S_IWOTH:
        raise ConfigError(f"everybody may write to {folder}, and put another socket there: chmod o-w, or choose another place")


def _remove_stale(path: Path) -> None:
    """The socket of a daemon that is gone. Raises where it is anything else."""
    try:
        found = path.lstat()
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(found.st_mode):
        raise ConfigError(f"{path} is there already and is no socket: look at it, and remove it")
    if found.st_uid != os.geteuid():
        raise ConfigError(f"{path} belongs to somebody else (uid {found.st_uid}): remove it, or choose another place")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(str(path))
        except (ConnectionRefusedError, FileNotFoundError):
            path.unlink(missing_ok=True)
            return
        except OSError as error:
            raise PortBusy(f"{path} does not answer ({error}): is a daemon hanging there?") from None
        pid = peer_credentials(probe)[0]
    raise PortBusy(f"a servobus daemon (pid {pid}) listens at {path} already: use it, stop it, or set SERVOBUS_SOCKET")


def inode(path: Path) -> int | None:
    """What tells the socket there from another that took its place; None: there is none."""
    try:
        found = path.lstat()
    except OSError:
        return None
    return found.st_ino if stat.S_ISSOCK(found.st_mode) else None


def remove(path: Path, own: int | None) -> None:
    """At the end; somebody else's socket stays."""
    if own is not None and inode(path) == own:
        path.unlink(missing_ok=True)


class Tokens:
    """The one token of a TCP door, and who may try how often. Times in seconds."""

    def __init__(self, options: TcpOptions) -> None:
        self._digest = hashlib.sha256(read_token(Path(options.token_file))).digest()
        self._failures: dict[str, deque[float]] = {}

    def check(self, address: str, token: str | None, now: float) -> None:
        """Raises AccessDenied, Overloaded."""
        failures = self._failures.setdefault(address, deque(maxlen=TRIES))
        if len(failures) == TRIES and now - failures[0] < WINDOW:
            raise Overloaded(f"too many wrong tokens from {address}: wait a minute")
        said = hashlib.sha256((token or "").encode("utf-8", "surrogatepass")).digest()
        if not hmac.compare_digest(said, self._digest):
            failures.append(now)
            if len(self._failures) > 4096:
                self._failures.pop(next(iter(self._failures)))
            raise AccessDenied("the token is not the one in the daemon's token_file")
        self._failures.pop(address, None)


def read_token(path: Path) -> bytes:
    """Raises ConfigError for a file that others can read, or that holds too little."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError as error:
        raise ConfigError(
            f"door.tcp.token_file {path} cannot be read ({error.strerror}): make one, "
            f"`(umask 077; head -c 32 /dev/urandom | base64 > {path})`"
        ) from None
    with os.fdopen(descriptor, "rb") as file:
        mode = os.fstat(descriptor).st_mode
        if not stat.S_ISREG(mode) or mode & (stat.S_IRWXG | stat.S_IRWXO):
            raise ConfigError(f"door.tcp.token_file {path} can be read by others: chmod 600 {path}")
        token = file.read(4096).strip()
    if len(token) < MIN_TOKEN:
        raise ConfigError(f"door.tcp.token_file {path} holds fewer than {MIN_TOKEN} characters: make it longer")
    return token


def tls_context(options: TcpOptions) -> ssl.SSLContext | None:
    """Raises ConfigError."""
    if options.tls is None:
        return None
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    try:
        context.load_cert_chain(options.tls.certificate, options.tls.key)
    except (OSError, ssl.SSLError) as error:
        raise ConfigError(f"door.tcp.tls: certificate and key cannot be used ({error})") from None
    return context
