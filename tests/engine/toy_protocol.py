"""A tiny protocol for tests of the engine: `A5 id size payload sum`, one byte of payload says what is meant.

READ asks for a register and is answered by its value: all answers of a node look alike, so they can be mistaken. PING
is answered by the number it carries, which makes it the fence. WRITE is confirmed by the same bytes, as some protocols do.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Sequence
from dataclasses import dataclass
from typing import Any, cast

from servobus.engine.coalescer import Coalescer, Ticket
from servobus.engine.health import Condition, Health, Node
from servobus.engine.scheduler import QUEUE_LIMIT, Scheduler
from servobus.errors import DeviceError
from servobus.protocols.base import Driver, GoalPlan, Plan, Poll, Request
from servobus.values import Goal, Outcome, ServoGoal

READ, PING, WRITE, ANSWER = 1, 2, 3, 0x80
ALL = 0xFF
REFUSED = 0xEE
"""As a value: the device says no."""


def encode(node: int, *payload: int) -> bytes:
    body = bytes((node, len(payload), *payload))
    return b"\xa5" + body + bytes((sum(body) & 0xFF,))


@dataclass(frozen=True, slots=True)
class ToyReply:
    frame: bytes

    @property
    def node(self) -> int:
        return self.frame[1]

    @property
    def payload(self) -> bytes:
        return self.frame[3:-1]

    @property
    def key(self) -> Hashable:
        return tuple(self.payload) if self.payload[0] == PING | ANSWER else self.payload[0]

    @property
    def status(self) -> int | None:
        return 0


def reply(node: int, *payload: int) -> ToyReply:
    return ToyReply(encode(node, payload[0] | ANSWER, *payload[1:]))


class ToyCodec:
    def __init__(self) -> None:
        self._heard = b""
        self.skipped = 0

    @property
    def pending(self) -> int:
        return len(self._heard)

    def receive_data(self, data: bytes) -> None:
        self._heard += data

    def next_reply(self) -> ToyReply | None:
        while len(self._heard) >= 5:
            size = self._heard[2] + 4
            if self._heard[0] == 0xA5 and len(self._heard) < size:
                return None
            frame = self._heard[:size]
            if frame[0] == 0xA5 and sum(frame[1:-1]) & 0xFF == frame[-1]:
                self._heard = self._heard[size:]
                return ToyReply(frame)
            self._heard, self.skipped = self._heard[1:], self.skipped + 1
        return None

    def reset(self) -> None:
        self._heard = b""

    def describe(self, frame: bytes, *, sent: bool) -> str:
        return f"{'>' if sent else '<'} {frame.hex(' ')}"


class ToyRequest(Request[Any]):
    """The value is the answer's second byte; of several nodes, a dict."""

    def __init__(self, node: int, *payload: int, nodes: tuple[int, ...] | None = None, **traits: Any) -> None:
        self.node, self.frame = node, encode(node, *payload)
        self.nodes = (() if node == ALL else (node,)) if nodes is None else nodes
        self.replies = len(self.nodes)
        self.reply_size = 6
        self.reply_key = (payload[0] | ANSWER, *payload[1:]) if payload[0] == PING else payload[0] | ANSWER
        for name, value in traits.items():
            setattr(self, name, value)

    def answers(self, reply: ToyReply) -> bool:
        return reply.node in self.nodes and reply.key == self.reply_key

    def parse(self, replies: Sequence[ToyReply]) -> Any:
        values = {each.node: each.payload[1] for each in replies}
        if REFUSED in values.values():
            raise DeviceError("it says no")
        return values if len(self.nodes) > 1 else next(iter(values.values()), None)

    def plain(self) -> Request[Any] | None:
        return read(self.node, self.frame[4]) if self.frame[3] == WRITE else None


def read(node: int, register: int = 0, **traits: Any) -> ToyRequest:
    return ToyRequest(node, READ, register, **traits)


def write(node: int, value: int, **traits: Any) -> ToyRequest:
    return ToyRequest(node, WRITE, value, **traits)


def group_read(*nodes: int, **traits: Any) -> ToyRequest:
    return ToyRequest(ALL, READ, 0, nodes=nodes, **{"partial": True, **traits})


def shout(value: int = 0) -> ToyRequest:
    return ToyRequest(ALL, WRITE, value)


class ToyDriver:
    """Servos `s1`, `s2`, ... at nodes 1, 2, ...; a goal turn is one broadcast for at most `most` servos."""

    def __init__(self, most: int = 8) -> None:
        self.most = most
        self.restarted: set[int] = set()
        self.refusal: Exception | None = None
        """What `plan` raises."""

    def fence(self, node: int, avoid: Sequence[Hashable], enabled: bool) -> Plan[bool]:
        number = next(number for number in range(256) if (PING | ANSWER, number) not in avoid)
        yield ToyRequest(node, PING, number)
        return node not in self.restarted

    def plan_goals(self, goals: Sequence[ServoGoal], *, together: bool, confirm: bool) -> list[GoalPlan]:
        if self.refusal is not None:
            raise self.refusal
        names = [goal.servo for goal in goals]
        most = len(names) if together else self.most
        parts = [tuple(names[at : at + most]) for at in range(0, len(names), most)]
        return [GoalPlan(part, self._say(part)) for part in parts]

    @staticmethod
    def _say(servos: tuple[str, ...]) -> Plan[dict[str, Outcome | Exception]]:
        yield shout(len(servos))
        return dict.fromkeys(servos, Outcome.SENT)


def ticket(number: int, ended: list[tuple[str, Any]], *, expires: float = 1.0, **traits: Any) -> Ticket:
    """A goal of servo `s<number>`; how it ends is told to `ended`."""
    servo = f"s{number}"
    return Ticket(
        ServoGoal(servo, Goal("position", 0.0)), number, expires, lambda result: ended.append((servo, result)), **traits
    )


class Sink:
    """What a caller holds: all it was told, in order."""

    def __init__(self) -> None:
        self.results: list[Any] = []
        self.cancelled = False

    def done(self) -> bool:
        return self.cancelled or bool(self.results)

    def set_result(self, value: Any, /) -> None:
        self.results.append(value)

    def set_exception(self, error: BaseException, /) -> None:
        self.results.append(error)


class Bench:
    """A scheduler with its health, without a line. All nodes have been heard."""

    def __init__(self, *nodes: int, online: bool = True, limit: int = QUEUE_LIMIT, most: int = 8) -> None:
        self.driver = ToyDriver(most)
        self.changes: list[tuple[int, Condition, Condition]] = []
        self.updates: list[Any] = []
        self.restarts: list[int] = []
        self.cuts: list[tuple[str, Exception]] = []
        self.health = Health(nodes or (1, 2, 3), changed=self._changed)
        self.scheduler = Scheduler(
            cast("Driver", self.driver),
            self.health,
            on_update=self.updates.append,
            on_restart=lambda node: self.restarts.append(node.id),
            on_cut=lambda servo, error: self.cuts.append((servo, error)),
            cycle=10.0,
            limit=limit,
        )
        if online:
            for node in list(self.health.nodes.values()):
                self.health.recovered(node)
            self.changes.clear()

    @property
    def coalescer(self) -> Coalescer:
        return self.scheduler.coalescer

    def node(self, number: int) -> Node:
        return self.health.node(number)

    def take_offline(self, number: int, now: float = 0.0) -> None:
        while self.node(number).condition is not Condition.OFFLINE:
            self.health.missed(self.node(number), READ | ANSWER, now, now)

    def _changed(self, node: Node, before: Condition) -> None:
        self.changes.append((node.id, before, node.condition))
        self.scheduler.node_changed(node)


def poll(name: str, hz: float, *nodes: int) -> Poll:
    """One group read of those that are reachable."""

    def request(reachable: Collection[int]) -> ToyRequest | None:
        wanted = [node for node in nodes if node in reachable]
        return group_read(*wanted) if wanted else None

    return Poll(name, hz, nodes, request)
