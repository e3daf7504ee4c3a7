"""Which link a port means, and what is refused before anything is opened."""

from __future__ import annotations

import pytest

from servobus.errors import ConfigError
from servobus.links import SCHEMES, check_port, open_link
from servobus.links.serial import SerialLink
from servobus.links.tcp import TcpLink


@pytest.mark.parametrize(
    ("port", "kind"),
    [
        ("/dev/ttyUSB0", SerialLink),
        ("/dev/serial/by-path/platform-usb-0:1.2:1.0", SerialLink),
        ("tcp://192.0.2.10:4001", TcpLink),
        ("tcp://device-server:23", TcpLink),
        ("tcp://device-server:1", TcpLink),
        ("tcp://device-server:65535", TcpLink),
        ("tcp://[2001:db8::1]:4001", TcpLink),
    ],
)
def test_the_link_of_a_port(port: str, kind: type) -> None:
    check_port(port)
    link = open_link(port, 512_000)
    assert type(link) is kind
    assert (link.address, link.traits.baudrate) == (port, 512_000)


@pytest.mark.parametrize(
    "port",
    [
        "tcp://",
        "tcp:server:23",
        "tcp:/server:23",
        "tcp://server",
        "tcp://:23",
        "tcp://server:0",
        "tcp://server:65536",
        "tcp://server:port",
        "tcp://server:23/path",
        "tcp://server:23?query",
        "tcp://server:23#fragment",
        "tcp://user@server:23",
        "tcp://[::1:23",
        "tcp://a..b:23",
        f"tcp://{64 * 'a'}:23",
    ],
)
def test_bad_addresses(port: str) -> None:
    with pytest.raises(ConfigError, match=r"cannot be read: write tcp://HOST:PORT$") as caught:
        check_port(port)
    assert str(caught.value).startswith(f"port {port!r} ")


@pytest.mark.parametrize("port", ["socket://server:23", "udp://server:23", "://", "http://server"])
def test_unknown_schemes(port: str) -> None:
    """All known forms are listed."""
    with pytest.raises(ConfigError, match=r"is not known; write a device path, tcp://HOST:PORT, realman://HOST:PORT.* or sim:$"):
        open_link(port, 9_600)


def test_schemes_are_lower_case() -> None:
    """A config is read by people: one spelling."""
    assert all(scheme.isalpha() and scheme.islower() and form.startswith(f"{scheme}://") for scheme, (_, form) in SCHEMES.items())
