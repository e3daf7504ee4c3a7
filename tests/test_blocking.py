"""The blocking rig: verbs that wait, a thread that lives as long as the rig, Ctrl-C, several callers. In real time."""

from __future__ import annotations

import asyncio
import inspect
import runpy
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from servobus import blocking
from servobus.errors import LimitError, LinkDown, UnknownName
from servobus.remote.rig import connect
from servobus.rig.interface import Rig, Servo
from servobus.values import Goal, Outcome, State
from tests.scripted_daemon import STATE, PuppetDaemon, puppet_daemon
from tests.simulated_rigs import config

ACKED = {"result": {"arm/s1": "acked"}}


@contextmanager
def daemon(path: Path) -> Iterator[PuppetDaemon]:
    """In another thread, as it would be in another process."""
    puppet, ready = PuppetDaemon(), threading.Event()
    puppet.answers["send_all"] = ACKED
    puppet.answers["renew"] = {"result": {"names": ["arm/s1"], "lease_ms": 300}}

    async def serve() -> None:
        ends.append(asyncio.Event())
        async with puppet_daemon(path, puppet):
            ready.set()
            await ends[0].wait()

    ends: list[asyncio.Event] = []
    thread = threading.Thread(target=asyncio.run, args=(serve(),))
    thread.start()
    ready.wait(10)
    try:
        yield puppet
    finally:
        puppet.loop.call_soon_threadsafe(ends[0].set)
        thread.join(10)


def until(condition: Callable[[], Any]) -> None:
    deadline = time.monotonic() + 10
    while not condition():
        assert time.monotonic() < deadline, "it never came to be"
        time.sleep(0.002)


def threads() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name == "servobus"]


@pytest.fixture(autouse=True)
def no_thread_is_left() -> Iterator[None]:
    yield
    assert threads() == []


def test_verbs(tmp_path: Path) -> None:
    with daemon(tmp_path / "s") as puppet, blocking.connect(tmp_path / "s") as rig:
        assert dict(rig.names) == {"arm/s1": ("arm", "s1"), "arm/s2": ("arm", "s2")}
        assert [servo.name for servo in rig] == ["arm/s1", "arm/s2"]
        assert rig["s1"].move_to(30) is Outcome.ACKED
        assert rig.move({"s1": 3}, speed=5) == {"arm/s1": Outcome.ACKED}
        assert rig.send("s1", Goal("velocity", 3)) is Outcome.ACKED
        puppet.answers["read"] = {"result": STATE}
        state = rig["s1"].read()
        assert isinstance(state, State)
        assert state.position == 1.5
        assert rig.snapshot()["arm/s1"].position == 1.5
        assert rig.stats() == {"arm": {"up": True}}
        assert not rig.stopped
        with pytest.raises(UnknownName, match="arm/s1"):
            rig["elbow"]
        with pytest.raises(LimitError):
            rig["s1"].move_to(float("nan"))
    assert puppet.calls("release") == [{}]
    with pytest.raises(LinkDown, match="was left"):
        rig["s1"].read()
    rig.close()


def test_a_rig_of_its_own() -> None:
    with blocking.open(config()) as rig:
        rig.enable()
        assert rig["s1"].move_to(3) is Outcome.ACKED
        assert rig["s1"].settle().position == pytest.approx(3, abs=0.9)
        asked_ids: list[int] = []
        rig.disable()
        assert [hit.id for hit in rig.scan("arm", ids=[2], progress=lambda asked, count, hit: asked_ids.append(asked))] == [2]
        assert asked_ids == [1]


def test_signatures_are_those_of_the_rig() -> None:
    for mine, theirs in ((blocking.BlockingRig, Rig), (blocking.BlockingServo, Servo)):
        verbs = {name for name, verb in vars(theirs).items() if inspect.iscoroutinefunction(verb) and not name.startswith("_")}
        for name in verbs:
            assert inspect.signature(getattr(mine, name)) == inspect.signature(getattr(theirs, name))
            assert inspect.getdoc(getattr(mine, name)) == inspect.getdoc(getattr(theirs, name))
    assert inspect.signature(blocking.connect).parameters == inspect.signature(connect).parameters


def test_watching_and_events(tmp_path: Path) -> None:
    with daemon(tmp_path / "s") as puppet, blocking.connect(tmp_path / "s") as rig:
        snapshots = rig.watch(hz=5)
        assert next(snapshots)["arm/s1"].position == 1.5
        states = {"arm/s1": STATE | {"position": 7}, "arm/s2": STATE}
        in_daemon(puppet, lambda: puppet.visitor.notify("state", stopped=False, states=states))
        assert next(snapshots)["arm/s1"].position == 7
        snapshots.close()
        until(lambda: puppet.calls("unsubscribe"))
        assert {"topic": "events"} in puppet.calls("subscribe")
        events = rig.events()
        in_daemon(puppet, lambda: puppet.visitor.notify("events", name="estop", time=1.0, fields={}))
        assert next(events).name == "estop", "what happens between the call and `next` is not lost"
        events.close()
        for _ in rig.watch(hz=5):
            break


def in_daemon(puppet: PuppetDaemon, act: Callable[[], None]) -> None:
    puppet.loop.call_soon_threadsafe(act)


def test_leases_are_renewed_while_the_script_computes(tmp_path: Path) -> None:
    with daemon(tmp_path / "s") as puppet, blocking.connect(tmp_path / "s") as rig:
        rig["s1"].move_to(1)
        until(lambda: len(puppet.calls("renew")) >= 5)
        assert not puppet.calls("acquire")


def test_several_threads(tmp_path: Path) -> None:
    with daemon(tmp_path / "s") as puppet, blocking.connect(tmp_path / "s") as rig:
        puppet.answers["ping"] = lambda _, message: {"result": int(message["params"]["name"][-1])}
        wrong: list[int | None] = []

        def ping(number: int) -> None:
            wrong.extend(reply for _ in range(50) if (reply := rig.ping(f"s{number}")) != number)

        callers = [threading.Thread(target=ping, args=(1 + number % 2,)) for number in range(8)]
        for caller in callers:
            caller.start()
        for caller in callers:
            caller.join(20)
        assert wrong == []
        assert len(puppet.calls("ping")) == 400


def test_ctrl_c_during_a_call(tmp_path: Path) -> None:
    with daemon(tmp_path / "s") as puppet, blocking.connect(tmp_path / "s") as rig:
        main = threading.get_ident()
        puppet.answers["ping"] = lambda *_: signal.pthread_kill(main, signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            rig.ping("s1")
        puppet.answers["ping"] = {"result": 5}
        assert rig.ping("s1") == 5
    assert puppet.calls("release") == []


def test_left_by_an_error(tmp_path: Path) -> None:
    with daemon(tmp_path / "s") as puppet:
        with pytest.raises(ZeroDivisionError), blocking.connect(tmp_path / "s") as rig:
            fail(rig["s1"].move_to(1))
        until(lambda: puppet.visitor.gone)
        assert puppet.calls("release") == []


def fail(outcome: Outcome, error: type[BaseException] = ZeroDivisionError) -> None:
    assert outcome is Outcome.ACKED
    raise error


def test_left_while_another_thread_waits(tmp_path: Path) -> None:
    with daemon(tmp_path / "s") as puppet:
        rig = blocking.connect(tmp_path / "s")
        puppet.answers["ping"] = lambda *_: None
        errors: list[Exception] = []

        def ping() -> None:
            try:
                rig.ping("s1")
            except LinkDown as error:
                errors.append(error)

        waiting = threading.Thread(target=ping)
        waiting.start()
        until(lambda: puppet.calls("ping"))
        rig.close()
        waiting.join(10)
        assert len(errors) == 1


def test_ctrl_c_while_connecting(tmp_path: Path) -> None:
    main = threading.get_ident()
    with daemon(tmp_path / "s") as puppet:
        puppet.answers["hello"] = lambda *_: signal.pthread_kill(main, signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            blocking.connect(tmp_path / "s")


def test_nobody_listens(tmp_path: Path) -> None:
    with pytest.raises(LinkDown, match="servobus run"):
        blocking.connect(tmp_path / "s")


@pytest.mark.parametrize("call", ["connect", "open"])
def test_a_failure_to_open_prints_one_traceback(call: str, tmp_path: Path) -> None:
    code = f"from servobus import blocking; blocking.{call}({str(tmp_path / 'missing')!r})"
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert process.returncode == 1
    assert process.stderr.count("Traceback") == 1, process.stderr
    assert "missing" in process.stderr.splitlines()[-1]


def test_ctrl_c_in_the_block_counts_as_a_loss(tmp_path: Path) -> None:
    with daemon(tmp_path / "s") as puppet:
        with pytest.raises(KeyboardInterrupt), blocking.connect(tmp_path / "s") as rig:
            fail(rig["s1"].move_to(1), KeyboardInterrupt)
        until(lambda: puppet.visitor.gone)
        assert puppet.calls("release") == []


def test_events_of_a_rig_of_its_own_begin_at_the_call() -> None:
    with blocking.open(config()) as rig:
        events = rig.events()
        rig.stop()
        rig.clear()
        assert [next(events).name for _ in range(2)] == ["estop", "estop_cleared"]


def test_a_rig_that_another_thread_waits_for_can_be_closed() -> None:
    """A call without an end, on a rig of its own, ends with the rig."""
    rig = blocking.open(config())
    errors: list[Exception] = []

    def wait() -> None:
        try:
            next(rig.events())
        except LinkDown as error:
            errors.append(error)

    waiting = threading.Thread(target=wait)
    waiting.start()
    rig.snapshot()
    rig.close()
    waiting.join(10)
    assert len(errors) == 1


UNCLOSED = """
from pathlib import Path
from servobus import blocking
from servobus.config.loader import parse_config
config = parse_config({text!r}, "arm.yaml", Path())
rig = blocking.open(config)
rig.enable()
events = rig.events()
import atexit
blocking.atexit.unregister(blocking._leave_all)
atexit.register(lambda: print("left:", rig._thread.rig.left["arm/s1"].action))
atexit.register(blocking._leave_all)
{end}
"""


@pytest.mark.parametrize(("end", "status"), [("", 0), ("raise SystemExit(3)", 3), ("raise ValueError", 1)])
def test_a_script_that_forgets_to_close_ends_and_applies_on_exit(end: str, status: int) -> None:
    bus = "{protocol: sms, port: 'sim:', baudrate: 1000000, servos: {s1: {id: 1, model: sts, on_exit: limp}}}"
    text = f"version: 1\nbuses: {{arm: {bus}}}\n"
    code = UNCLOSED.format(text=text, end=end)
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30, check=False)
    assert (process.stdout, process.returncode) == ("left: limp\n", status), process.stderr


def test_the_stub_is_what_the_script_writes() -> None:
    script = runpy.run_path(str(Path(__file__).parent.parent / "scripts" / "stubs"))
    text = script["stub"]((script["RIG"] / "interface.py").read_text())
    assert (script["RIG"] / "blocking_verbs.pyi").read_text() == text, "run scripts/stubs"


def test_a_callback_may_not_wait_for_its_own_thread(tmp_path: Path) -> None:
    caught: list[BaseException] = []
    with blocking.open(config()) as rig:

        def progress(*_: object) -> None:
            with pytest.raises(RuntimeError, match="own thread") as error:
                rig.ping("s1")
            caught.append(error.value)

        rig.scan("arm", ids=[1], progress=progress)
    assert len(caught) == 1
