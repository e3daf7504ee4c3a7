"""FLOOR 1: how bytes reach a line. Which link a `port` means stands here and nowhere else."""

from __future__ import annotations

from collections.abc import Callable
from urllib.parse import SplitResult, parse_qs, urlsplit

from servobus.errors import ConfigError
from servobus.links.base import Link
from servobus.links.realman import RealmanLink
from servobus.links.serial import SerialLink
from servobus.links.tcp import TcpLink


def _tcp(parts: SplitResult, baudrate: int) -> Link:
    host, port = parts.hostname, parts.port  # port raises ValueError for what is no port
    if not host or not port or parts.path or parts.query or parts.fragment or parts.username is not None:
        raise ValueError
    host.encode("idna")  # raises UnicodeError, a ValueError, for what can be no name
    return TcpLink(host, port, baudrate)


def _realman(parts: SplitResult, baudrate: int) -> Link:
    host, tcp_port = parts.hostname, parts.port
    keys = parse_qs(parts.query, keep_blank_values=True, strict_parsing=bool(parts.query))
    if not host or not tcp_port or parts.path or parts.fragment or parts.username is not None or set(keys) - set(ARM):
        raise ValueError
    if any(len(values) > 1 or values[0] not in ARM[key] for key, values in keys.items()):
        raise ValueError
    host.encode("idna")
    said = {key: int(values[0]) for key, values in keys.items()}
    return RealmanLink(
        host, tcp_port, baudrate, port=said.get("port", 1), generation=said.get("generation"), volts=said.get("voltage")
    )


ARM = {"port": ("0", "1"), "generation": ("2", "3", "4"), "voltage": ("0", "5", "12", "24")}
"""What may be said of an arm. Port 0: the controller's RS485, 1: the one at the tool; generation: not asked for; voltage: of the
tool, else left as it is."""
SCHEMES: dict[str, tuple[Callable[[SplitResult, int], Link], str]] = {
    "tcp": (_tcp, "tcp://HOST:PORT"),
    "realman": (_realman, "realman://HOST:PORT?port=1 (and &generation=2|3|4, &voltage=0|5|12|24)"),
}
"""Scheme -> how it is opened, and how it is written."""


TUNNELS = {"realman": "roh"}
"""Scheme -> the one protocol that passes through it."""


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
