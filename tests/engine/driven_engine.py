"""An engine whose line the test plays, and plans for it to run."""

from __future__ import annotations

from typing import Any

from servobus.engine.engine import Engine, WaitUntil
from servobus.engine.job import Job, JobKind
from servobus.engine.line import Line
from servobus.engine.stats import BusStats
from servobus.engine.turn import Transmit, Turn
from servobus.errors import ServobusError
from servobus.protocols.base import LineTraits, Plan, Request
from tests.engine.toy_protocol import ANSWER, PING, READ, Bench, Sink, ToyCodec, read, reply, shout


class Rig(Bench):
    """An engine driven by bytes and times. All nodes are online unless the test says otherwise."""

    def __init__(self, *nodes: int, online: bool = True, **options: Any) -> None:
        super().__init__(*nodes, online=online, **options)
        self.stats = BusStats(0.0)
        self.line = Line(LineTraits())
        self.engine = Engine("arm", ToyCodec(), self.scheduler, self.line, self.stats)
        self.engine.opened(0.0)
        if online:
            for node in list(self.nodes.by_id.values()):
                self.nodes.fenced(node)
            self.changes.clear()
        self.now = 1.0

    def submit(self, request: Request[Any] | None = None, *, plan: Plan[Any] | None = None, **traits: Any) -> list[Any]:
        """Submit a job; returns the list into which its result is put."""
        sink = Sink()
        self.engine.submit(Job(sink, 100.0, request=request, plan=plan, **traits), self.now)
        return sink.results

    def estop(self, plan: Plan[Any]) -> list[Any]:
        sink = Sink()
        self.engine.submit_stop(Job(sink, 100.0, plan=plan, node=1, kind=JobKind.ESTOP))
        return sink.results

    def transmit(self) -> Transmit | None:
        """The next frame that the engine transmits, after any silence that it waits for; None: nothing is to be sent."""
        action = self.engine.next_action(self.now)
        while isinstance(action, WaitUntil) and self.line.waiting_for_silence:
            self.now = action.when
            action = self.engine.next_action(self.now)
        return action if isinstance(action, Transmit) else None

    def next(self) -> bytes:
        """The payload transmitted next; empty: nothing. A request without replies is concluded."""
        action = self.transmit()
        if action is None:
            return b""
        self.engine.deliver()
        return action.frame[3:-1]

    def hear(self, *frames: bytes, latency: float = 0.001) -> Turn:
        """The next request is transmitted, and these frames are all that comes."""
        turn = self.transmit()
        assert isinstance(turn, Turn)
        self.receive(*frames, after=latency)
        if self.engine.in_flight:
            self.now = turn.deadline
            self.engine.timed_out(self.now)
        return turn

    def receive(self, *frames: bytes, after: float = 0.001) -> None:
        """These frames arrive in one piece."""
        self.now += after
        if frames:
            self.engine.receive(b"".join(frames), self.now)
        self.engine.deliver()

    def answer(self, value: int = 0) -> bytes:
        """The next request is transmitted and answered as it should be; returns its payload."""
        turn = self.transmit()
        assert isinstance(turn, Turn)
        payload = turn.frame[3:-1]
        self.receive(*(reply(node, payload[0], payload[1] if payload[0] == PING else value).frame for node in turn.request.nodes))
        return payload

    def miss(self) -> bytes:
        """The next request is transmitted, and nothing comes; returns its payload."""
        return self.hear().frame[3:-1]

    def doubt(self, node: int, key: Any = READ | ANSWER) -> None:
        self.nodes.doubt(self.node(node), key, self.now)


def three_reads() -> Plan[list[int]]:
    values = []
    for register in (10, 11, 12):
        values.append((yield read(1, register)))  # noqa: PERF401 - a plan cannot yield inside a comprehension
    return values


def careful() -> Plan[str]:
    try:
        yield read(1, 10)
    except ServobusError as error:
        yield shout(1)
        return type(error).__name__
    return "well"


def stop_plan(frames: int = 1) -> Plan[str]:
    for number in range(frames):
        yield read(1, 100 + number)
    return "stopped"


FENCE = bytes((PING, 0))


def ask(register: int) -> bytes:
    return bytes((READ, register))
