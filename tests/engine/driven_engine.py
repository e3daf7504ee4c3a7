"""A runner whose line the test speaks for, and plans for it to run."""

from __future__ import annotations

from typing import Any

from servobus.engine.engine import Runner
from servobus.engine.queue import Job
from servobus.engine.stats import BusStats
from servobus.engine.turn import Turn, judge
from servobus.errors import ServobusError
from servobus.protocols.base import Plan, Request
from tests.engine.toy_protocol import ANSWER, PING, READ, Bench, Sink, ToyCodec, read, reply, shout


class Rig(Bench):
    """A runner whose line the test speaks for. All nodes are online unless the test says otherwise."""

    def __init__(self, *nodes: int, **keys: Any) -> None:
        super().__init__(*nodes, **keys)
        self.stats = BusStats(0.0)
        self.runner = Runner("arm", self.scheduler, self.health, self.stats)
        self.now = 1.0

    def submit(self, request: Request[Any] | None = None, *, plan: Plan[Any] | None = None, **traits: Any) -> list[Any]:
        """What its caller was told."""
        sink = Sink()
        self.scheduler.submit(Job(sink, 100.0, request=request, plan=plan, **traits), self.now)
        return sink.results

    def estop(self, plan: Plan[Any]) -> list[Any]:
        sink = Sink()
        self.scheduler.drop(self.runner.estopped, motion_only=True)
        self.scheduler.estop.append(Job(sink, 100.0, plan=plan, node=1))
        return sink.results

    def next(self) -> bytes:
        """The payload said next; empty: nothing. What nobody answers is reported as sent."""
        request = self.runner.next_request(self.now)
        if request is None:
            return b""
        if not request.replies:
            self.runner.sent(request)
        return request.frame[3:-1]

    def hear(self, *frames: bytes, latency: float = 0.001) -> Turn:
        """The next request is said, and these frames are all that comes."""
        request = self.runner.next_request(self.now)
        assert request is not None
        turn, codec, strays = Turn(request, sent_at=self.now, sent_by=self.now, deadline=self.now), ToyCodec(), list[Any]()
        codec.receive_data(b"".join(frames))
        believed = judge(codec, turn, strays)
        if strays:
            self.runner.strays(strays, turn, self.now)
        if believed:
            self.runner.answered(turn, latency)
        else:
            self.runner.missed(turn, self.now, latency)
        return turn

    def answer(self, value: int = 0) -> bytes:
        """The next request is said and properly answered; its payload."""
        request = self.runner.next_request(self.now)
        assert request is not None
        payload = request.frame[3:-1]
        told = payload[1] if payload[0] == PING else value
        self.hear(*(reply(node, payload[0], told).frame for node in request.nodes))
        return payload

    def miss(self) -> bytes:
        request = self.runner.next_request(self.now)
        assert request is not None
        self.hear()
        return request.frame[3:-1]

    def doubt(self, node: int, key: Any = READ | ANSWER) -> None:
        self.health.doubt(self.node(node), key, self.now)


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
