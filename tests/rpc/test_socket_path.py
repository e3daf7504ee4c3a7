"""Where the socket is, and how its address is written."""

from __future__ import annotations

import ssl
from pathlib import Path

import pytest

from servobus.errors import ConfigError
from servobus.remote.address import address_of
from servobus.rpc.socket_path import socket_path


@pytest.mark.parametrize(
    ("environ", "path"),
    [
        ({"SERVOBUS_SOCKET": "/a/b", "RUNTIME_DIRECTORY": "/r", "XDG_RUNTIME_DIR": "/x"}, "/a/b"),
        ({"RUNTIME_DIRECTORY": "/r:/other", "XDG_RUNTIME_DIR": "/x"}, "/r/servobus.sock"),
        ({"XDG_RUNTIME_DIR": "/x"}, "/x/servobus/servobus.sock"),
        ({"SERVOBUS_SOCKET": "", "XDG_RUNTIME_DIR": ""}, "/run/servobus/servobus.sock"),
    ],
)
def test_the_path(environ: dict[str, str], path: str) -> None:
    assert socket_path(environ) == Path(path)


def test_a_daemon_does_not_listen_at_an_address_that_is_for_clients() -> None:
    with pytest.raises(ConfigError, match=r"listens at a path; unset it, and use `door: tcp:`"):
        socket_path({"SERVOBUS_SOCKET": "tcp://127.0.0.1:7337"})


def test_the_named_daemon_comes_before_the_usual_one(monkeypatch: pytest.MonkeyPatch) -> None:
    for named in ("/a/b.sock", "tcp://127.0.0.1:7337"):
        monkeypatch.setenv("SERVOBUS_SOCKET", named)
        assert str(address_of(None, tls=False)) == named


def test_addresses() -> None:
    assert str(address_of("/run/x.sock", tls=False)) == "/run/x.sock"
    assert address_of(Path("x"), tls=False).path == Path("x")
    for text in ("tcp://127.0.0.1:7000", "tcp://[::1]:7000", "tcp://localhost:1"):
        address = address_of(text, tls=False)
        assert str(address) == text
        assert address.tls is None
    context = ssl.create_default_context()
    assert address_of("tcp://robot.example:7000", tls=context).tls is context
    assert address_of("tcp://robot.example:7000", tls=True).tls is not None
    with pytest.raises(ConfigError, match="no TLS"):
        address_of("/run/x.sock", tls=True)
