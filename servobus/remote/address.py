"""The address of a daemon, its token, TLS, and the errors of a daemon that cannot be reached."""

from __future__ import annotations

import asyncio
import os
import ssl
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from servobus.errors import AccessDenied, ConfigError, LinkDown
from servobus.remote.connection import DaemonConnection
from servobus.rpc.socket_path import find_socket, named_daemon, socket_path
from servobus.values import is_loopback

CONNECT_TIMEOUT = 5.0  # seconds for the connection to open
MAX_TOKEN = 4096


class NoDaemon(LinkDown):
    """Nobody listens at the address: no daemon was started there, or it has died."""


@dataclass(frozen=True, slots=True)
class Address:
    """A Unix socket, or a host and port."""

    path: Path | None = None
    host: str = ""
    port: int = 0
    tls: ssl.SSLContext | None = None

    def __str__(self) -> str:
        return str(self.path) if self.path else f"tcp://{f'[{self.host}]' if ':' in self.host else self.host}:{self.port}"

    async def open(self, make: Callable[[], DaemonConnection]) -> DaemonConnection:
        """Open a connection. Raises LinkDown, AccessDenied."""
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(CONNECT_TIMEOUT):
                if self.path:
                    return (await loop.create_unix_connection(make, str(self.path)))[1]
                return (await loop.create_connection(make, self.host, self.port, ssl=self.tls))[1]
        except PermissionError:
            raise AccessDenied(f"{self}: this user may not open the socket: become a member of its group") from None
        except ssl.SSLError as error:
            raise LinkDown(f"{self}: no TLS with the daemon ({error.reason or error}): check its certificate and `tls`") from None
        except (FileNotFoundError, ConnectionRefusedError):
            raise NoDaemon(f"no daemon listens at {self}: start it: servobus run CONFIG") from None
        except TimeoutError:
            raise LinkDown(f"{self} does not take the connection within {CONNECT_TIMEOUT:g} s: is its daemon stopped?") from None
        except OSError as error:
            raise LinkDown(f"{self}: {error.strerror or error}: check the address, or start it: servobus run CONFIG") from None


def address_of(address: str | Path | None, tls: bool | str | Path | ssl.SSLContext) -> Address:
    """The address that a person wrote, else the one that SERVOBUS_SOCKET names, else the usual one. Raises ConfigError.

    A TCP address without `tls` is asked by the certificates of SERVOBUS_CA_FILE, where that is set.
    """
    text = str(address or named_daemon() or find_socket() or socket_path())
    if "://" not in text:
        if tls:
            raise ConfigError(f"{text}: a Unix socket has no TLS: leave `tls` away, or connect to tcp://host:port")
        return Address(Path(text))
    try:
        url = urlsplit(text)
        host, port = url.hostname, url.port
    except ValueError as error:
        raise ConfigError(f"{text}: {error}: write tcp://host:port") from None
    if url.scheme != "tcp" or not host or not port or url.path or url.query or url.username:
        raise ConfigError(f"{text} is no address of a daemon: write the path of its socket, or tcp://host:port")
    tls = tls or os.environ.get("SERVOBUS_CA_FILE") or False
    if not tls and not is_loopback(host):
        readable = "the token would be readable on the way"
        raise ConfigError(f"{text} is another machine, and {readable}: give tls=True, or its CA file (SERVOBUS_CA_FILE)")
    return Address(host=host, port=port, tls=_context(tls) if tls else None)


def _context(tls: bool | str | Path | ssl.SSLContext) -> ssl.SSLContext:
    if isinstance(tls, ssl.SSLContext):
        return tls
    try:
        return ssl.create_default_context(cafile=None if tls is True else str(tls))
    except (OSError, ssl.SSLError) as error:
        raise ConfigError(f"{tls}: no certificates in it ({error}): give the PEM file that the daemon's is signed by") from None


def token_of(token: str | None, token_file: str | Path | None) -> str | None:
    """The token, else that of a file, else that of SERVOBUS_TOKEN_FILE. Raises ConfigError.

    A file is read again at each connection, so that a token may change.
    """
    if token is not None and token_file is not None:
        raise ConfigError("give a token or a token_file, not both")
    token_file = token_file or os.environ.get("SERVOBUS_TOKEN_FILE")
    if token is not None or not token_file:
        return token
    try:
        with Path(token_file).open("rb") as file:
            text = file.read(MAX_TOKEN + 1).decode("ascii").strip()
    except (OSError, UnicodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not ASCII text"
        raise ConfigError(f"{token_file}: {reason}: give the daemon's token file, readable for you") from None
    if not text or len(text) > MAX_TOKEN:
        raise ConfigError(f"{token_file}: no token in it: give the daemon's token file")
    return text
