"""FLOOR 1: how bytes reach a line. Which link a `port` means stands here and nowhere else."""

from __future__ import annotations

from collections.abc import Callable
from urllib.parse import SplitResult, urlsplit

from servobus.errors import ConfigError
from servobus.links.base import Link
from servobus.links.serial import SerialLink
from servobus.links.tcp import TcpLink


def _tcp(parts: SplitResult, baudrate: int) -> Link:
    host, port = parts.hostname, parts.port  # port raises ValueError for what is no port
    if not host or not port or parts.path or parts.query or parts.fragment or parts.username is not None:
        raise ValueError
    host.encode("idna")  # raises UnicodeError, a ValueError, for what can be no name
    return TcpLink(host, port, baudrate)


SCHEMES: dict[str, tuple[Callable[[SplitResult, int], Link], str]] = {
    "tcp": (_tcp, "tcp://HOST:PORT"),
}
"""Scheme -> how it is opened, and how it is written."""


def open_link(port: str, baudrate: int, *, rs485: bool = False) -> Link:
    """The link of a config's `port`: a device path, or one of the schemes. Opens nothing. Raises ConfigError."""
    scheme, separator, rest = port.partition(":")
    if scheme in SCHEMES:
        build, form = SCHEMES[scheme]
        try:
            return build(urlsplit(port), baudrate)
        except ValueError:
            raise ConfigError(f"port {port!r} cannot be read: write {form}") from None
    if separator and rest.startswith("//"):
        known = ", ".join(form for _, form in SCHEMES.values())
        raise ConfigError(f"port {port!r}: {scheme}:// is not known; write a device path, {known} or sim:")
    return SerialLink(port, baudrate, rs485=rs485)


def check_port(port: str) -> None:
    """Raises ConfigError for what `open_link` would refuse."""
    open_link(port, 9600)
