"""Who may do what, and who does not come in: roles, tokens, counts, and places for the socket that are not safe."""

from __future__ import annotations

import asyncio
import os
import socket
import stat
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest

from servobus.config.access import AccessOptions, DoorOptions, Role, TcpOptions
from servobus.config.loader import parse_config
from servobus.daemon.methods import HANDLERS
from servobus.daemon.sockets import MAX_PATH, Tokens, claim, read_token
from servobus.errors import AccessDenied, ConfigError, Overloaded, PortBusy
from servobus.rpc.methods import METHODS, needed_role
from tests.daemon.raw_client import Raw, dialled, served
from tests.virtual_time import virtual

TOKEN = "correct-horse-battery-staple-0123456789"
OBSERVERS = {
    *("stop", "names", "read", "snapshot", "stopped", "settle", "read_register", "ping", "identify", "health", "stats"),
    *("config", "leases", "subscribe", "unsubscribe", "cancel"),
}
OPERATORS = {
    *("move", "move_to", "spin", "send_all", "enable", "disable", "clear", "acquire", "renew", "release", "write_register"),
    "scan",
}
ADMINS = {"set_id", "set_baudrate", "command", "reload"}
EXAMPLES: dict[str, dict[str, Any]] = {
    **{method: {"name": "s1"} for method in ("read", "ping", "identify")},
    "read_register": {"name": "s1", "register": "id"},
    "subscribe": {"topic": "events"},
    "unsubscribe": {"subscription": 99},
    "cancel": {"call": 99},
    "move": {"positions": {"s1": 1}},
    "move_to": {"name": "s1", "position": 1},
    "spin": {"name": "s1", "velocity": 1},
    "send_all": {"goals": {"s1": {"kind": "position", "value": 1}}},
    "write_register": {"name": "s1", "register": "torque_limit", "value": 50},
    "scan": {"bus": "arm", "ids": [1]},
    "set_id": {"bus": "arm", "node": 1, "new": 9},
    "set_baudrate": {"bus": "arm", "node": 1, "baudrate": 9600},
    "command": {"bus": "arm", "node": 1, "name": "restart"},
}


def test_every_method_has_its_role_and_its_verb() -> None:
    assert set(METHODS) == {"hello"} | OBSERVERS | OPERATORS | ADMINS == set(HANDLERS)
    for names, role in ((OBSERVERS, Role.OBSERVER), (OPERATORS, Role.OPERATOR), (ADMINS, Role.ADMIN)):
        assert {METHODS[name].role for name in names} == {role}
    assert needed_role("write_register", METHODS["write_register"].params("s1", "id", 2, persist=True)) is Role.ADMIN


@pytest.mark.parametrize("role", list(Role))
@virtual
async def test_every_method_by_every_role(role: Role, tmp_path: Path) -> None:
    async with served(tmp_path, clients_per_user=100) as (_, door, path):
        for method, row in METHODS.items():
            async with dialled(path) as raw:
                await raw.call("stopped")
                list(door.connections)[-1].role = role
                answer = await raw.call(method, **EXAMPLES.get(method, {}))
                denied = isinstance(answer, dict) and answer.get("type") == "AccessDenied"
                assert denied is (role < row.role), f"{method} as {role}: {answer}"


@virtual
async def test_what_stays_for_good_is_an_admins(tmp_path: Path) -> None:
    async with served(tmp_path) as (_, door, path), dialled(path) as raw:
        await raw.call("stopped")
        next(iter(door.connections)).role = Role.OPERATOR
        params = {"name": "s1", "register": "return_delay", "value": 4, "raw": True}
        assert (await raw.call("write_register", **params, persist=True))["type"] == "AccessDenied"
        assert (await raw.call("write_register", **params))["type"] == "NotSupported", "not without the word for it either"


@pytest.mark.parametrize(
    ("access", "uid", "role"),
    [
        ({}, 0, Role.ADMIN),
        ({}, 1000, Role.ADMIN),
        ({}, 1001, Role.OBSERVER),
        ({"admin": ["nobody"]}, 0, Role.OBSERVER),
        ({"admin": ["root"]}, 0, Role.ADMIN),
        ({"admin": ["root"]}, 1000, Role.OBSERVER),
        ({"operator": ["root"]}, 0, Role.OPERATOR),
        ({"operator": ["@root"]}, 0, Role.OPERATOR),
        ({"admin": ["@root"]}, 54_321, Role.OBSERVER),
    ],
)
def test_roles_follow_from_credentials(access: dict[str, Any], uid: int, role: Role) -> None:
    assert AccessOptions(**access).role_of(uid, 54_321 if uid else 0, owner=1000) is role


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become somebody else")
@virtual
async def test_another_user_looks_on_and_may_stop() -> None:
    with TemporaryDirectory() as folder:
        os.chmod(folder, 0o755)
        await _as_another(Path(folder))


async def _as_another(folder: Path) -> None:
    async with served(folder) as (_, door, path):
        os.chmod(path, 0o666)
        os.seteuid(65_534)
        try:
            sock = socket.socket(socket.AF_UNIX)
            sock.connect(str(path))
        finally:
            os.seteuid(0)
        raw = Raw(*await asyncio.open_unix_connection(sock=sock))
        assert (await raw.call("hello"))["role"] == "observer"
        assert (await raw.call("move_to", name="s1", position=1))["type"] == "AccessDenied"
        assert (await raw.call("stop"))["arm/s1"]["written"] is not None
        await raw.close()
        assert door.rig.stopped


# How many


@virtual
async def test_there_is_an_end_to_connections(tmp_path: Path) -> None:
    async with served(tmp_path, clients_per_user=2) as (_, door, path), dialled(path) as one, dialled(path) as two:
        assert [await each.call("stopped") for each in (one, two)] == [False, False]
        async with dialled(path) as third:
            assert (await third.line())["error"]["data"]["type"] == "Overloaded"
            with suppress(ConnectionError):
                assert await third.line() is None
        assert await one.call("stopped") is False
        await two.close()
        await asyncio.sleep(0.01)
        async with dialled(path) as fourth:
            assert await fourth.call("stopped") is False
        assert len(door.connections) <= 2


# TCP


def token_file(folder: Path, text: str = TOKEN, mode: int = 0o600) -> Path:
    path = folder / "token"
    path.write_text(text + "\n")
    path.chmod(mode)
    return path


@pytest.mark.parametrize("token", [None, "", " ", TOKEN[:-1], TOKEN + "x", TOKEN.upper(), "ключ" * 10, "\ud800"])
def test_tokens_that_are_not_the_one(token: str | None, tmp_path: Path) -> None:
    tokens = Tokens(TcpOptions(port=0, token_file=str(token_file(tmp_path))))
    with pytest.raises(AccessDenied) as caught:
        tokens.check("a", token, 0.0)
    assert TOKEN not in str(caught.value)
    tokens.check("a", TOKEN, 0.0)


def test_guessing_is_slow_and_locks_nobody_else_out(tmp_path: Path) -> None:
    tokens = Tokens(TcpOptions(port=0, token_file=str(token_file(tmp_path))))
    for number in range(5):
        with pytest.raises(AccessDenied):
            tokens.check("attacker", "x", float(number))
    for _ in range(1000):
        with pytest.raises(Overloaded, match="wait a minute"):
            tokens.check("attacker", TOKEN, 10.0)
    tokens.check("friend", TOKEN, 10.0)
    tokens.check("attacker", TOKEN, 61.0)


@pytest.mark.parametrize(
    ("text", "mode", "why"),
    [(TOKEN, 0o644, "chmod 600"), (TOKEN, 0o640, "chmod 600"), ("short", 0o600, "fewer than 32 characters")],
)
def test_token_files_that_keep_no_secret(text: str, mode: int, why: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=why) as caught:
        read_token(token_file(tmp_path, text, mode))
    assert text not in str(caught.value)


def test_a_token_file_that_is_missing_or_a_link(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="make one"):
        read_token(tmp_path / "none")
    (tmp_path / "link").symlink_to(token_file(tmp_path))
    with pytest.raises(ConfigError, match="cannot be read"):
        read_token(tmp_path / "link")


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.2", "robot.example"])
def test_nothing_is_open_to_the_network_without_tls(host: str) -> None:
    bus = "buses: {a: {protocol: sms, port: 'sim:', baudrate: 9600}}"
    text = f"version: 1\n{bus}\ndoor: {{tcp: {{host: '{host}', port: 1, token_file: t}}}}\n"
    with pytest.raises(ConfigError, match=r"c:3:8: door\.tcp: .*can be reached from other machines: give tls"):
        parse_config(text, "c")
    with pytest.raises(ConfigError, match="token_file"):
        parse_config(text.replace(", token_file: t", ""), "c")


async def test_tcp_shows_its_token_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tcp = TcpOptions(port=0, token_file=str(token_file(tmp_path)))
    async with served(tmp_path, tcp=tcp) as (_, door, _):
        port = int(door.addresses[1].rpartition(":")[2])
        raw = Raw(*await asyncio.open_connection("127.0.0.1", port))
        assert (await raw.call("read", name="s1"))["message"] == "say hello first, with the token"
        assert (await raw.call("stop"))["type"] == "AccessDenied"
        assert (await raw.call("hello", token="wrong"))["type"] == "AccessDenied"
        assert await raw.line() is None
        await raw.close()
        raw = Raw(*await asyncio.open_connection("127.0.0.1", port))
        assert (await raw.call("hello", token=TOKEN))["role"] == "operator"
        assert await raw.call("stopped") is False
        assert (await raw.call("reload"))["type"] == "AccessDenied"
        everything = str(await raw.call("config")) + str(await raw.call("stats")) + str(door.options)
        await raw.close()
    printed = capsys.readouterr()
    assert TOKEN not in everything + printed.out + printed.err


# The path of the socket


def test_a_new_folder_is_ours_alone(tmp_path: Path) -> None:
    path = tmp_path / "run" / "servobus.sock"
    with claim(path):
        assert stat.S_IMODE(path.parent.stat().st_mode) == 0o750
        assert stat.S_IMODE(path.stat().st_mode) == 0o660


def test_a_socket_path_that_is_too_long(tmp_path: Path) -> None:
    long = tmp_path / ("s" * (MAX_PATH - len(str(tmp_path))))
    with pytest.raises(ConfigError, match=rf"more than {MAX_PATH} bytes.*SERVOBUS_SOCKET to a shorter path"):
        claim(long)
    longest = long.with_name(long.name[:-1])
    with claim(longest):
        assert longest.is_socket()


def test_a_second_daemon_names_the_first(tmp_path: Path) -> None:
    path = tmp_path / "s"
    with claim(path), pytest.raises(PortBusy, match=rf"daemon \(pid {os.getpid()}\) listens at .* already: use it, stop it"):
        claim(path)


def test_the_socket_of_one_that_was_killed_is_taken_over(tmp_path: Path) -> None:
    path = tmp_path / "s"
    claim(path).close()
    assert path.is_socket()
    claim(path).close()


@pytest.mark.parametrize("kind", ["file", "link", "folder"])
def test_what_is_no_socket_is_left_alone(kind: str, tmp_path: Path) -> None:
    path, other = tmp_path / "s", tmp_path / "other"
    other.write_text("mine")
    if kind == "file":
        path.write_text("mine")
    elif kind == "link":
        path.symlink_to(other)
    else:
        path.mkdir()
    with pytest.raises(ConfigError, match="is not a socket"):
        claim(path)
    assert other.read_text() == "mine"
    assert path.exists()


@pytest.mark.parametrize("mode", [0o777, 0o1777, 0o757])
def test_a_folder_that_is_open_to_all_is_refused(mode: int, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    folder.chmod(mode)
    with pytest.raises(ConfigError, match="everybody may write"):
        claim(folder / "s")


def test_a_folder_that_is_a_link_is_refused(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "run").symlink_to(tmp_path / "real")
    with pytest.raises(ConfigError, match="is not a folder"):
        claim(tmp_path / "run" / "s")


@pytest.mark.parametrize("theirs", [False, True])
async def test_at_the_end_its_own_socket_is_removed_and_no_other(theirs: bool, tmp_path: Path) -> None:
    async with served(tmp_path) as (_, _, path):
        assert path.exists()
        if theirs:
            (tmp_path / "kept").hardlink_to(path)  # so that its number is not given to the next
            path.unlink()
            other = socket.socket(socket.AF_UNIX)
            other.bind(str(path))
            other.close()
    assert path.exists() is theirs


def test_defaults_of_the_door() -> None:
    assert (DoorOptions().tcp, DoorOptions().clients, DoorOptions().lease_ms) == (None, 1000, 500)
