"""RemoteRig against a daemon that fails it: lost connections, lost leases, servers that hang, lie or babble. In virtual time."""

from __future__ import annotations

import asyncio
import math
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from servobus.client import RemoteRig, connect
from servobus.errors import (
    AccessDenied,
    ConfigError,
    LeaseHeld,
    LimitError,
    LinkDown,
    NotSupported,
    Overloaded,
    ReplyTimeout,
    ServobusError,
    UnknownName,
)
from servobus.events import Event
from servobus.opening import open_rig
from servobus.protocols.words import Goal, Outcome
from servobus.rpc.methods import MAX_LINE
from servobus.session import SILENCE
from servobus.wire import MAX_ANSWER, MAX_WAITING
from tests.door import open_test_door
from tests.puppet_daemon import GREETING, STATE, PuppetDaemon, Visitor, failed, puppet_daemon
from tests.rigs import config
from tests.virtual import virtual

LEASE = 0.3
ACKED = {"result": {"arm/s1": "acked"}}


async def until(condition: Any) -> None:
    """In virtual time, which leaps: ten seconds of it."""
    for _ in range(10_000):
        if condition():
            return
        await asyncio.sleep(0.001)
    raise AssertionError("it never came to be")


async def alive(daemon: PuppetDaemon, seconds: float) -> None:
    """Let time pass, with a daemon that says something now and then."""
    for _ in range(int(seconds * 10)):
        await asyncio.sleep(0.1)
        daemon.visitor.notify("state", stopped=False, states={"arm/s1": STATE, "arm/s2": STATE})


async def refused(path: Path, **options: Any) -> ServobusError:
    with pytest.raises(ServobusError) as caught:
        async with connect(path, **options):
            pass
    return caught.value


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
    "place", ["http://host:1", "tcp://host", "tcp://:80", "tcp://localhost:99999", "tcp://localhost:1/x", "tcp://u@localhost:1"]
)
@virtual
async def test_an_address_that_is_none(place: str) -> None:
    with pytest.raises(ConfigError, match="tcp://host:port"):
        async with connect(place):
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
            assert daemon.calls("hello") == [{"client": "arm app", "token": "abc", "protocol": 1}]
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
        b"x" * (MAX_ANSWER + 1),
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
async def test_a_connection_refused_in_words(tmp_path: Path) -> None:
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
async def test_a_daemon_that_hangs_costs_a_call_its_deadline_and_no_more(tmp_path: Path) -> None:
    asked: list[int] = []

    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        daemon.answers["ping"] = lambda _, message: asked.append(message["id"])
        talk = asyncio.create_task(alive(daemon, 60))
        with pytest.raises(ReplyTimeout, match="ping within 10 s: it may have been applied"):
            await rig.ping("s1")
        daemon.visitor.say({"id": asked[0], "result": 3})  # nobody waits for it any more
        daemon.answers["ping"] = {"result": 4}
        assert await rig.ping("s1") == 4
        talk.cancel()


@virtual
async def test_a_silent_daemon_is_a_lost_one(tmp_path: Path) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        daemon.answers["ping"] = lambda *_: None
        with pytest.raises(LinkDown, match=f"silent for {SILENCE:g} s; ping was under way and may have been applied"):
            await rig.ping("s1")
        await until(lambda: len(daemon.visitors) == 2)


@virtual
async def test_a_scan_goes_on_as_long_as_it_reports(tmp_path: Path) -> None:
    def answer(visitor: Visitor, message: dict[str, Any]) -> None:
        scans.append(message["id"])

    scans: list[int] = []
    seen: list[tuple[int, int]] = []
    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        daemon.answers["scan"] = answer
        scan = asyncio.create_task(rig.scan("arm", progress=lambda asked, count, _: seen.append((asked, count))))
        for asked in range(4):
            await alive(daemon, 20)
            progress = {"id": scans[0], "bus": "arm", "asked": asked, "count": 4, "found": None}
            daemon.visitor.say({"method": "progress", "params": progress})
        daemon.visitor.say({"id": scans[0], "result": [{"bus": "arm", "id": 1, "baudrate": 5, "model": "sts"}]})
        with pytest.raises(LinkDown, match="another version"):  # a Found has more fields
            await scan
    assert seen == [(0, 4), (1, 4), (2, 4), (3, 4)]


@virtual
async def test_a_call_that_is_too_much(tmp_path: Path) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        with pytest.raises(LimitError, match="split it"):
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
        before = len(daemon.heard)
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
        with pytest.raises(LimitError, match="twice"):
            await rig.move({"s1": 1, "arm/s1": 1})
        assert await rig.move({}) == {}
        assert len(daemon.heard) == before


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


# The connection goes and comes


@virtual
async def test_a_lost_connection_fails_what_is_under_way_and_repeats_nothing(tmp_path: Path) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        daemon.answers["send_all"] = lambda visitor, _: visitor.transport.abort()
        with pytest.raises(LinkDown, match="send_all was under way and may have been applied"):
            await rig["s1"].move_to(5)
        with pytest.raises(LinkDown, match="nothing was sent, it is tried again by itself"):
            await rig["s1"].move_to(6)
        assert {state.health for state in rig.snapshot().values()} == {"offline"}
        with pytest.raises(LinkDown):
            rig.stats()
        daemon.answers["hello"] = {"result": GREETING | {"stopped": True, "names": {"leg/knee": ["leg", "knee"]}}}
        daemon.answers["snapshot"] = {"result": {"leg/knee": STATE}}
        await until(lambda: list(rig.names) == ["leg/knee"])
        assert rig.stopped
        assert rig.snapshot()["leg/knee"].health == "online"
        assert rig.stats() == {"arm": {"up": True}}
        await asyncio.sleep(1)
        assert len(daemon.calls("send_all")) == 1


@virtual
async def test_it_is_tried_more_and_more_rarely(tmp_path: Path) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        events: list[Event] = []
        listening = asyncio.create_task(listen(rig, events))
        await asyncio.sleep(0.1)
        daemon.answers["hello"] = failed("AccessDenied", "not today")
        daemon.visitor.transport.abort()
        await asyncio.sleep(20)
        assert 12 <= len(daemon.visitors) <= 16  # 0.05, 0.1 ... 2, 2, 2
        with pytest.raises(LinkDown, match="not today"):
            await rig.ping("s1")
        daemon.answers["hello"] = {"result": GREETING}
        await asyncio.sleep(2.1)
        daemon.visitor.notify("events", name="estop", time=1.0, fields={})
        await asyncio.sleep(0.1)
        listening.cancel()
    assert [event.name for event in events] == ["daemon_lost", "daemon_back", "estop"]


async def listen(rig: RemoteRig, events: list[Event]) -> None:
    async for event in rig.events():
        events.append(event)  # noqa: PERF401 - it never ends


@virtual
async def test_watching_goes_on(tmp_path: Path) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        seen = []

        async def watch() -> None:
            async for snapshot in rig.watch(hz=50):
                seen.append((snapshot["arm/s1"].position, snapshot["arm/s1"].health))  # noqa: PERF401 - it never ends

        watching = asyncio.create_task(watch())
        await until(lambda: seen)
        assert {"topic": "state", "hz": 50} in daemon.calls("subscribe")
        for position in range(3):  # a slow reader gets the newest
            daemon.visitor.notify("state", stopped=False, states={"arm/s1": STATE | {"position": position}, "arm/s2": STATE})
        await asyncio.sleep(0.1)
        daemon.visitor.transport.abort()
        await asyncio.sleep(1)
        daemon.visitor.notify("state", stopped=False, states={"arm/s1": STATE | {"position": 9}, "arm/s2": STATE})
        await asyncio.sleep(0.1)
        watching.cancel()
        await asyncio.sleep(0.1)
        assert len(daemon.calls("unsubscribe")) == 1
    assert seen == [(1.5, "online"), (2, "online"), (2, "offline"), (9, "online")]


@virtual
async def test_a_watcher_that_leaves_at_once_leaves_no_subscription(tmp_path: Path) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        watching = [asyncio.ensure_future(anext(aiter(rig.watch()))) for _ in range(5)]
        await asyncio.sleep(0)
        for task in watching:
            task.cancel()
        await until(lambda: len(daemon.calls("unsubscribe")) == 5)
        assert len({params["subscription"] for params in daemon.calls("unsubscribe")}) == 5


@virtual
async def test_names_follow_a_reload_by_somebody_else(tmp_path: Path) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        daemon.answers["names"] = {"result": {"arm/s1": ["arm", "s1"], "arm/s9": ["arm", "s9"]}}
        daemon.visitor.notify("state", stopped=True, states={"arm/s1": STATE, "arm/s9": STATE})
        await until(lambda: "arm/s9" in rig.names)
        assert rig.full_name("s9") == "arm/s9"
        assert rig.stopped
        assert list(rig.snapshot()) == ["arm/s1", "arm/s9"]


@pytest.mark.parametrize(
    ("method", "told"),
    [
        ("state", {}),
        ("state", {"stopped": False, "states": 1}),
        ("state", {"stopped": False, "states": {"arm/s1": {"position": "1"}}}),
        ("stats", {}),
        ("event", {"name": 3}),
        ("event", {}),
        ("progress", {}),
    ],
)
@virtual
async def test_a_notice_that_is_none_ends_the_connection(tmp_path: Path, method: str, told: dict[str, Any]) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        events: list[Event] = []
        listening = asyncio.create_task(listen(rig, events))
        await asyncio.sleep(0.1)
        for number in range(5):
            daemon.visitor.say({"method": method, "params": told | {"subscription": number}})
        await until(lambda: len(daemon.visitors) == 2)
        await asyncio.sleep(0.1)
        listening.cancel()
        assert [event.name for event in events] == ["daemon_lost", "daemon_back"]
        assert "another version" in str(events[0].fields["reason"])


# Leases


@virtual
async def test_a_lease_is_renewed_while_it_is_held(tmp_path: Path) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        daemon.answers["send_all"] = ACKED
        daemon.answers["renew"] = {"result": {"names": ["arm/s1"], "lease_ms": 300}}
        assert await rig["s1"].move_to(5) is Outcome.ACKED
        await asyncio.sleep(10 * LEASE)
        renewed = len(daemon.calls("renew"))
        assert 25 <= renewed <= 30
        assert not daemon.calls("acquire")
        await rig.release("s1")
        daemon.answers["renew"] = {"result": {"names": [], "lease_ms": 300}}
        await asyncio.sleep(10 * LEASE)
        assert len(daemon.calls("renew")) <= renewed + 3
    assert daemon.calls("release") == [{"names": ["arm/s1"]}, {}]


@virtual
async def test_what_was_lost_is_acquired_by_the_next_wish_only(tmp_path: Path) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        daemon.answers["send_all"] = failed("LeaseHeld", "its motion lease has expired", bus="arm", servo="s1")
        with pytest.raises(LeaseHeld, match="expired"):
            await rig["s1"].move_to(5)
        assert not daemon.calls("acquire")
        daemon.answers["send_all"] = ACKED
        await rig["s1"].move_to(6)
        assert daemon.calls("acquire") == [{"names": ["arm/s1"]}]
        assert [params["goals"]["arm/s1"]["value"] for params in daemon.calls("send_all")] == [5, 6]


@virtual
async def test_a_client_that_slept_through_its_lease_knows_it(tmp_path: Path) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        daemon.answers["send_all"] = ACKED
        daemon.answers["renew"] = lambda *_: None  # the daemon does not hear of us
        await rig["s1"].move_to(5)
        await asyncio.sleep(2 * LEASE)
        await rig["s1"].move_to(6)
        assert daemon.calls("acquire") == [{"names": ["arm/s1"]}]


@virtual
async def test_another_holder_is_named(tmp_path: Path) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon, connect(tmp_path / "s") as rig:
        daemon.answers["send_all"] = daemon.answers["acquire"] = failed("LeaseHeld", "web page moves it", bus="arm", servo="s1")
        for _ in range(2):
            with pytest.raises(LeaseHeld, match="arm/s1: web page moves it"):
                await rig["s1"].move_to(5)
        assert len(daemon.calls("send_all")) == 1  # the second stopped at the lease


@virtual
async def test_leaving(tmp_path: Path) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon:
        daemon.answers["send_all"] = ACKED
        async with connect(tmp_path / "s") as rig:
            await rig["s1"].move_to(5)
        await until(lambda: daemon.visitor.gone)
        assert daemon.calls("release") == [{}]
        with pytest.raises(LinkDown, match=r"has left; nothing was sent$"):
            await rig.ping("s1")
        with pytest.raises(LimitError):  # noqa: PT012 - the context has to see it too
            async with connect(tmp_path / "s") as rig:
                await rig["s1"].move_to(5)
                await rig["s1"].move_to(math.nan)
        await until(lambda: daemon.visitor.gone)
        assert daemon.calls("release") == [{}]
        daemon.answers["release"] = lambda *_: None  # a daemon that hangs does not hold up the end
        async with connect(tmp_path / "s") as rig:
            await rig["s1"].move_to(5)


@virtual
async def test_leaving_while_it_is_lost(tmp_path: Path) -> None:
    async with puppet_daemon(tmp_path / "s") as daemon:
        daemon.answers["send_all"] = ACKED
        async with connect(tmp_path / "s") as rig:
            await rig.send("s1", Goal("velocity", 3))
            daemon.visitor.transport.abort()
            await asyncio.sleep(0)
        count = len(daemon.visitors)
        await asyncio.sleep(5)
        assert len(daemon.visitors) == count


@pytest.mark.parametrize("way", ["release", "normal", "error", "killed"])
@virtual
async def test_what_becomes_of_motion_when_its_client_leaves(tmp_path: Path, way: str) -> None:
    setup, path = config("s1: {id: 1, model: sts, speed: 20, on_lost_client: hold}"), tmp_path / "s"
    async with open_rig(setup) as home, open_test_door(home, path) as door:
        with suppress(ZeroDivisionError):
            async with connect(path) as rig:
                await rig.enable()
                await rig["s1"].move_to(40)
                await asyncio.sleep(1)
                if way == "release":
                    await rig.release()
                    await asyncio.sleep(3)
                if way == "error":
                    raise ZeroDivisionError
                if way == "killed":
                    next(iter(door.connections)).abort()
                    await asyncio.sleep(3)
        await asyncio.sleep(3)
        finished = (await home.read("s1")).position == pytest.approx(40, abs=1)
        assert finished is (way in ("release", "normal"))


@virtual
async def test_two_clients_and_one_servo(tmp_path: Path) -> None:
    path = tmp_path / "s"
    async with open_rig(config()) as home, open_test_door(home, path), connect(path) as first, connect(path) as second:
        await first.enable()
        await first["s1"].move_to(5)
        await asyncio.sleep(5)
        for _ in range(2):
            with pytest.raises(LeaseHeld, match="arm/s1"):
                await second["s1"].move_to(6)
        assert await second["s2"].move_to(6) is Outcome.ACKED
        await second.stop()  # anyone may
        await until(lambda: first.stopped)
        await first.clear()
        await first.release("s1")
        assert await second["s1"].move_to(6) is Outcome.ACKED


def test_a_client_loads_no_engine() -> None:
    code = """
import sys, servobus.client, servobus.blocking
servobus.connect, servobus.Rig, servobus.LinkDown
engine = ("serial", "pydantic", "ruamel", "servobus.bus", "servobus.sim", "servobus.links", "servobus.protocols.sms")
print([name for name in sys.modules if name.startswith(engine)])
import servobus
assert servobus.open.__name__ == "open_rig" and "open" in dir(servobus)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout == "[]\n"
