"""The daemon's sockets: a path that is safe, the user at the other end, and tokens and TLS for TCP."""

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

GROUP = "servobus"  # members of this group may open the socket, where the system has it
FOLDER_MODE, SOCKET_UMASK = 0o750, 0o117
CREDENTIALS = struct.Struct("3i")
MIN_TOKEN = 32
TRIES, WINDOW = 5, 60.0  # wrong tokens that one address may try within so many seconds
BACKLOG = 1024
MAX_PATH = 107  # bytes of a socket's path: sun_path of Linux, less its final zero


def peer_credentials(sock: socket.socket) -> tuple[int, int, int]:
    """Process, user and group at the other end of a Unix socket, as the system knows them."""
    pid, uid, gid = CREDENTIALS.unpack(sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, CREDENTIALS.size))
    return pid, uid, gid


def claim(path: Path) -> socket.socket:
    """Listen at a path. Raises PortBusy where a daemon listens already, ConfigError where the path is not safe or too long."""
    if len(os.fsencode(path)) > MAX_PATH:
        raise ConfigError(f"{path} has more than {MAX_PATH} bytes, too many for a socket: set SERVOBUS_SOCKET to a shorter path")
    _make_folder(path.parent)
    _remove_stale(path)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
    before = os.umask(SOCKET_UMASK)  # so that the file never has another mode
    try:
        listener.bind(str(path))
    except OSError as error:
        listener.close()
        raise ConfigError(f"{path} cannot be made ({error.strerror or error}): set SERVOBUS_SOCKET to another path") from None
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
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode):
        raise ConfigError(f"{folder} is not a folder: remove it, or set SERVOBUS_SOCKET to another path")
    if status.st_uid not in (0, os.geteuid()):
        raise ConfigError(f"{folder} belongs to somebody else (uid {status.st_uid}): set SERVOBUS_SOCKET to another path")
    if status.st_mode & stat.S_IWOTH:
        raise ConfigError(f"everybody may write to {folder}, and replace the socket: chmod o-w, or choose another path")


def _remove_stale(path: Path) -> None:
    """Remove the socket of a daemon that has ended. Raises ConfigError and PortBusy where it is anything else."""
    try:
        status = path.lstat()
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(status.st_mode):
        raise ConfigError(f"{path} exists and is not a socket: look at it, and remove it")
    if status.st_uid != os.geteuid():
        raise ConfigError(f"{path} belongs to somebody else (uid {status.st_uid}): remove it, or choose another path")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(str(path))
        except (ConnectionRefusedError, FileNotFoundError):
            path.unlink(missing_ok=True)
            return
        except OSError as error:
            raise PortBusy(f"{path} does not answer ({error}): does a daemon hang there?") from None
        pid = peer_credentials(probe)[0]
    raise PortBusy(f"a servobus daemon (pid {pid}) listens at {path} already: use it, stop it, or set SERVOBUS_SOCKET")


def inode(path: Path) -> int | None:
    """The inode of the socket at a path; None: there is none."""
    try:
        status = path.lstat()
    except OSError:
        return None
    return status.st_ino if stat.S_ISSOCK(status.st_mode) else None


def remove(path: Path, own: int | None) -> None:
    """Remove our own socket at the end; the socket of another daemon stays."""
    if own is not None and inode(path) == own:
        path.unlink(missing_ok=True)


class Tokens:
    """The token of a TCP daemon, and how often an address may try. Times in seconds."""

    def __init__(self, options: TcpOptions) -> None:
        self._digest = hashlib.sha256(read_token(Path(options.token_file))).digest()
        self._failures: dict[str, deque[float]] = {}

    def check(self, address: str, token: str | None, now: float) -> None:
        """Check a token. Raises AccessDenied, Overloaded."""
        failures = self._failures.setdefault(address, deque(maxlen=TRIES))
        if len(failures) == TRIES and now - failures[0] < WINDOW:
            raise Overloaded(f"too many wrong tokens from {address}: wait a minute")
        digest = hashlib.sha256((token or "").encode("utf-8", "surrogatepass")).digest()
        if not hmac.compare_digest(digest, self._digest):
            failures.append(now)
            if len(self._failures) > 4096:
                self._failures.pop(next(iter(self._failures)))
            raise AccessDenied("the token is not the one in the daemon's token_file")
        self._failures.pop(address, None)


def read_token(path: Path) -> bytes:
    """The token of a file. Raises ConfigError for a file that others can read, or whose token is too short."""
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
    """The TLS of a TCP daemon; None: it has none. Raises ConfigError."""
    if options.tls is None:
        return None
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    try:
        context.load_cert_chain(options.tls.certificate, options.tls.key)
    except (OSError, ssl.SSLError) as error:
        raise ConfigError(f"door.tcp.tls: certificate and key cannot be used ({error})") from None
    return context
