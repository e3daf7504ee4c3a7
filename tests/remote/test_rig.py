"""RemoteRig against a daemon that refuses, hangs, lies or babbles. In virtual time."""

from __future__ import annotations

import asyncio
import math
import socket
from pathlib import Path
from typing import Any

import pytest

from servobus.errors import (
    AccessDenied,
    ConfigError,
    InvalidRequest,
    LimitError,
    LinkDown,
    NotSupported,
    Overloaded,
    ReplyTimeout,
    UnknownName,
)
from servobus.remote.connection import MAX_REPLY, MAX_WAITING
from servobus.remote.rig import connect
from servobus.remote.session import SILENCE
from servobus.rpc.methods import MAX_LINE
from tests.scripted_daemon import GREETING, STATE, Visitor, failed, puppet_daemon
from tests.virtual_time import virtual
from tests.waiting import alive, refused, until

# Coming in


@virtual
async def test_nobody_listens(tmp_path: Path) -> None:
    left = socket.socket(socket.AF_UNIX)
    left.bind(str(tmp_path / "left.sock"))
    left.close()
    for path in (tmp_path / "none.sock", tmp_path / "left.sock"):
        error = await refused(path)
        assert isinstance(error, LinkDown)
        assert "start it: servobus run CONFIG" in str(error)
        assert str(path) in str(error)


@virtual
async def test_what_is_there_is_no_socket(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert isinstance(await refused(tmp_path / "file"), LinkDown)


@pytest.mark.parametrize(
    "address", ["http://host:1", "tcp://host", "tcp://:80", "tcp://localhost:99999", "tcp://localhost:1/x", "tcp://u@localhost:1"]
)
@virtual
async def test_an_address_that_is_none(address: str) -> None:
    with pytest.raises(ConfigError, match="tcp://host:port"):
        async with connect(address):
            pass


@virtual
async def test_a_token_never_goes_to_another_machine_in_the_clear(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="tls"):
        async with connect("tcp://192.0.2.1:7000", token="x" * 32):
            pass
    with pytest.raises(ConfigError, match="certificates"):
        async with connect("tcp://192.0.2.1:7000", token="x" * 32, tls=tmp_path / "ca.pem"):
            pass


@virtual
async def test_tokens(tmp_path: Path) -> None:
    path, token = tmp_path / "s.sock", tmp_path / "token"
    async with puppet_daemon(path) as daemon:
        token.write_text("  abc\n")
        async with connect(path, token_file=token, name="arm app"):
            (hello,) = daemon.calls("hello")
            assert (hello["client"], hello["token"], hello["protocol"]) == ("arm app", "abc", 1)
        assert isinstance(await refused(path, token="a", token_file=token), ConfigError)
        assert "empty" in str(await refused(path, token_file=tmp_path / "empty"))
        daemon.answers["hello"] = failed("AccessDenied", "the token is not right")
        assert isinstance(await refused(path, token="secret"), AccessDenied)
        assert "secret" not in str(await refused(path, token="secret"))


@virtual
async def test_another_protocol(tmp_path: Path) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon:
        daemon.answers["hello"] = {"result": GREETING | {"protocol": 2, "version": "9.9"}}
        error = await refused(tmp_path / "s")
        assert isinstance(error, NotSupported)
        assert "servobus 9.9 there speaks protocol 2" in str(error)
        daemon.answers["hello"] = {"error": {"code": -32602, "message": "no field client"}}
        assert isinstance(await refused(tmp_path / "s"), NotSupported)


@pytest.mark.parametrize(
    "babble",
    [
        b'{"jsonrpc":"2.0","method":"progress","params":{"bus":[]}}\n',
        b"HTTP/1.1 400 Bad Request\r\n\r\n",
        b"\n",
        b"[]\n",
        b"{}\n",
        b'{"jsonrpc":"2.0","id":7,"result":1}\n',
        b'{"jsonrpc":"2.0","id":-1,"result":1}\n',
        b'{"jsonrpc":"2.0","id":"1","result":1}\n',
        b'{"jsonrpc":"2.0","id":1,"result":{}}\n',
        b'{"jsonrpc":"2.0","id":1}\n',
        b'{"jsonrpc":"2.0","id":1,"result":null}\n',
        b'{"jsonrpc":"2.0","method":"state","params":1}\n',
        b'{"jsonrpc":"2.0","method":"state"}\n',
        b'{"jsonrpc":"2.0","id":1,"error":{"code":1e400}}\n',
        b"[" * 100_000 + b"\n",
        b"\x00\xff\xfe\n",
        b"x" * (MAX_REPLY + 1),
        b"",
    ],
)
@virtual
async def test_what_answers_talks_nonsense(tmp_path: Path, babble: bytes) -> None:
    def answer(visitor: Visitor, _: dict[str, Any]) -> None:
        visitor.raw(babble)

    async with puppet_daemon(tmp_path / "s") as daemon:
        daemon.answers["hello"] = answer
        error = await refused(tmp_path / "s")
        assert isinstance(error, LinkDown)
        assert "servobus daemon" in str(error) or "servobus run" in str(error)
        assert len(str(error)) < 500


@virtual
async def test_a_connection_refused_with_an_error(tmp_path: Path) -> None:
    def answer(visitor: Visitor, _: dict[str, Any]) -> None:
        visitor.say({"id": None, **failed("Overloaded", "1000 clients are connected already")})
        visitor.transport.close()

    async with puppet_daemon(tmp_path / "s") as daemon:
        daemon.answers["hello"] = answer
        assert "1000 clients" in str(await refused(tmp_path / "s"))


# Calls


@virtual
async def test_answers_that_come_late_twice_or_in_another_order(tmp_path: Path) -> None:
    asked: list[int] = []

    def answer(visitor: Visitor, message: dict[str, Any]) -> None:
        asked.append(message["id"])
        if len(asked) == 2:
            for number in (*reversed(asked), *asked):
                visitor.say({"id": number, "result": number})

    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        daemon.answers["ping"] = answer
        answers = await asyncio.gather(rig.ping("s1"), rig.ping("s2"))
        assert list(answers) == asked
        daemon.answers["ping"] = {"result": 7}
        assert await rig.ping("s1") == 7


@virtual
async def test_an_answer_about_another_servo_is_none(tmp_path: Path) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        daemon.answers["send_all"] = {"result": {"arm/s2": "acked"}}
        with pytest.raises(LinkDown, match=r"about arm/s2, not about arm/s1.*may have been applied"):
            await rig["s1"].move_to(5)
        await until(lambda: len(daemon.visitors) == 2)
        await asyncio.sleep(0.1)
        daemon.answers["settle"] = {"result": {"arm/s1": STATE, "arm/s2": STATE}}
        with pytest.raises(LinkDown, match="about arm/s1, arm/s2"):
            await rig["s1"].settle()


@virtual
async def test_a_daemon_that_hangs_costs_a_call_its_deadline(tmp_path: Path) -> None:
    asked: list[int] = []

    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        daemon.answers["ping"] = lambda _, message: asked.append(message["id"])
        talk = asyncio.create_task(alive(daemon, 60))
        with pytest.raises(ReplyTimeout, match=r"ping within 10 s$"):
            await rig.ping("s1")
        daemon.visitor.say({"id": asked[0], "result": 3})  # nobody waits for it any more
        daemon.answers["ping"] = {"result": 4}
        assert await rig.ping("s1") == 4
        talk.cancel()


@virtual
async def test_a_silent_daemon_is_a_lost_one(tmp_path: Path) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        daemon.answers["ping"] = lambda *_: None
        with pytest.raises(LinkDown, match=f"silent for {SILENCE:g} s; ping was under way$"):
            await rig.ping("s1")
        await until(lambda: len(daemon.visitors) == 2)


@virtual
async def test_a_scan_goes_on_as_long_as_it_reports(tmp_path: Path) -> None:
    def answer(visitor: Visitor, message: dict[str, Any]) -> None:
        scans.append(message["id"])

    scans: list[int] = []
    reports: list[tuple[int, int]] = []
    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        daemon.answers["scan"] = answer
        scan = asyncio.create_task(rig.scan("arm", progress=lambda asked, count, _: reports.append((asked, count))))
        for asked in range(4):
            await alive(daemon, 20)
            progress = {"id": scans[0], "bus": "arm", "asked": asked, "count": 4, "found": None}
            daemon.visitor.say({"method": "progress", "params": progress})
        daemon.visitor.say({"id": scans[0], "result": [{"bus": "arm", "id": 1, "baudrate": 5, "model": "sts"}]})
        with pytest.raises(LinkDown, match="another version"):  # a ScanHit has more fields
            await scan
    assert reports == [(0, 4), (1, 4), (2, 4), (3, 4)]


@virtual
async def test_a_call_that_is_too_much(tmp_path: Path) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        with pytest.raises(InvalidRequest, match="split it"):
            await rig.read_register("s1", "x" * MAX_LINE)
        daemon.answers["ping"] = lambda *_: None
        waiting = [asyncio.create_task(rig.ping("s1")) for _ in range(MAX_WAITING)]
        await asyncio.sleep(0.1)
        with pytest.raises(Overloaded, match="wait for the daemon"):
            await rig.ping("s1")
        daemon.answers["stop"] = {"result": {}}
        assert await rig.stop() == {}  # whatever waits
        for task in waiting:
            task.cancel()
        await asyncio.gather(*waiting, return_exceptions=True)
        daemon.answers["ping"] = {"result": 0}
        assert await rig.ping("s1") == 0


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, True, "1", None, 10**400, b"1", [1]])
@virtual
async def test_what_is_no_number_never_leaves(tmp_path: Path, value: Any) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        before = len(daemon.received)
        with pytest.raises(LimitError, match=r"arm/s1: value: .* is not a finite number"):
            await rig["s1"].move_to(value)
        with pytest.raises(LimitError, match="arm/s2"):
            await rig.move({"s1": 1, "s2": value})
        if value is not None:
            with pytest.raises(LimitError, match="speed"):
                await rig["s1"].move_to(1, speed=value)
        with pytest.raises(LimitError, match="register torque_limit"):
            await rig["s1"].write_register("torque_limit", value)
        with pytest.raises(UnknownName):
            await rig["s3"].move_to(1)
        with pytest.raises(InvalidRequest, match="twice"):
            await rig.move({"s1": 1, "arm/s1": 1})
        assert await rig.move({}) == {}
        assert len(daemon.received) == before


@virtual
async def test_states_carry_the_time_of_this_machine(tmp_path: Path) -> None:
    loop = asyncio.get_running_loop()
    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        await asyncio.sleep(3)
        assert rig.snapshot()["arm/s1"].age == pytest.approx(3.25)
        daemon.answers["read"] = {"result": STATE}
        state = await rig.read("s1")
        assert (state.time, state.age) == (loop.time() - 0.25, 0.25)
        await asyncio.sleep(0.5)
        assert rig.snapshot()["arm/s1"].age == pytest.approx(0.75)
