"""How bytes reach a line. `open_link` turns the `port` of a config into a link; no other module reads a port's address."""

from __future__ import annotations

from collections.abc import Callable
from urllib.parse import SplitResult, parse_qs, urlsplit

from servobus.errors import ConfigError
from servobus.links.base import Link
from servobus.links.realman import RealmanLink
from servobus.links.serial import SerialLink
from servobus.links.tcp import TcpLink


def _tcp(parts: SplitResult, baudrate: int) -> Link:
    if parts.query:
        raise ValueError
    return TcpLink(*_host_and_port(parts), baudrate)


def _realman(parts: SplitResult, baudrate: int) -> Link:
    query = parse_qs(parts.query, keep_blank_values=True, strict_parsing=bool(parts.query))
    if any(len(values) > 1 or values[0] not in ARM_KEYS.get(key, ()) for key, values in query.items()):
        raise ValueError
    options = {key: int(values[0]) for key, values in query.items()}
    port, generation, volts = options.get("port", 1), options.get("generation"), options.get("voltage")
    return RealmanLink(*_host_and_port(parts), baudrate, port=port, generation=generation, volts=volts)


def _host_and_port(parts: SplitResult) -> tuple[str, int]:
    host, port = parts.hostname, parts.port  # .port raises ValueError if it is not a port number
    if not host or not port or parts.path or parts.fragment or parts.username is not None:
        raise ValueError
    host.encode("idna")  # raises UnicodeError, a ValueError, if it cannot be a host name
    return host, port


ARM_KEYS = {"port": ("0", "1"), "generation": ("2", "3", "4"), "voltage": ("0", "5", "12", "24")}
"""The query keys of an arm's address, and their values.

port: 0 is the controller's RS485, 1 the one at the tool. generation: skips the question which generation the arm is. voltage:
volts at the tool; without the key, the supply stays as it is.
"""
SCHEMES: dict[str, tuple[Callable[[SplitResult, int], Link], str]] = {
    "tcp": (_tcp, "tcp://HOST:PORT"),
    "realman": (_realman, "realman://HOST:PORT?port=1 (and &generation=2|3|4, &voltage=0|5|12|24)"),
}
"""Scheme -> function that makes its link, and the form of its address."""


TUNNELS = {"realman": "roh"}
"""Scheme -> the one protocol that it can carry."""


def open_link(port: str, baudrate: int, *, rs485: bool = False) -> Link:
    """Return the link of a config's `port`: a device path, or an address with one of the schemes. Opens nothing.

    Raises ConfigError for an address it cannot read.
    """
    scheme, separator, rest = port.partition(":")
    if scheme in SCHEMES:
        build, form = SCHEMES[scheme]
        try:
            return build(urlsplit(port), baudrate)
        except ValueError:
            raise ConfigError(f"port {port!r} cannot be read: write {form}") from None
    if separator and rest.startswith("//"):
        forms = ", ".join(form for _, form in SCHEMES.values())
        raise ConfigError(f"port {port!r}: {scheme}:// is not known; write a device path, {forms} or sim:")
    return SerialLink(port, baudrate, rs485=rs485)


def check_port(port: str) -> None:
    """Check an address without opening it. Raises ConfigError where `open_link` would."""
    open_link(port, 9600)
