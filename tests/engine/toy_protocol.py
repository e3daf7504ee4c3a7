"""A tiny protocol for tests of the engine: `A5 id size payload sum`, one byte of payload says what is meant.

READ asks for a register and is answered by its value: all answers of a node look alike, so they can be mistaken. PING
is answered by the number it carries, which makes it the fence. WRITE is confirmed by the same bytes, as some protocols do.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

from servobus.engine.coalescer import Coalescer, Ticket
from servobus.engine.health import Node, NodeTable
from servobus.engine.scheduler import QUEUE_LIMIT, Scheduler
from servobus.errors import DeviceError
from servobus.protocols.base import Driver, GoalPlan, Plan, Poll, Request
from servobus.values import Goal, Health, Loss, Outcome, ServoGoal

READ, PING, WRITE, ANSWER = 1, 2, 3, 0x80
ALL = 0xFF
REFUSED = 0xEE
"""As a value: the device says no."""
RESTARTED = 0xDD
"""As a value of register 0: the device has restarted."""


def encode(node: int, *payload: int) -> bytes:
    content = bytes((node, len(payload), *payload))
    return b"\xa5" + content + bytes((sum(content) & 0xFF,))


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
        self._buffer = b""
        self.skipped = 0

    @property
    def pending(self) -> int:
        return len(self._buffer)

    def receive_data(self, data: bytes) -> None:
        self._buffer += data

    def next_reply(self) -> ToyReply | None:
        while len(self._buffer) >= 5:
            size = self._buffer[2] + 4
            if self._buffer[0] == 0xA5 and len(self._buffer) < size:
                return None
            frame = self._buffer[:size]
            if frame[0] == 0xA5 and sum(frame[1:-1]) & 0xFF == frame[-1]:
                self._buffer = self._buffer[size:]
                return ToyReply(frame)
            self._buffer, self.skipped = self._buffer[1:], self.skipped + 1
        return None

    def reset(self) -> None:
        self._buffer = b""

    def describe(self, frame: bytes, *, sent: bool) -> str:
        return f"{'>' if sent else '<'} {frame.hex(' ')}"


class ToyRequest(Request[Any]):
    """The value is the answer's second byte; of several nodes, a dict."""

    def __init__(self, node: int, *payload: int, nodes: tuple[int, ...] | None = None, **traits: Any) -> None:
        self.node, self.frame = node, encode(node, *payload)
        self.nodes = (() if node == ALL else (node,)) if nodes is None else nodes
        self.replies = len(self.nodes)
        self.reply_size = 6
        self.changes = payload[0] == WRITE
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
    """Servos `s1`, `s2`, ... at nodes 1, 2, ...; a goal plan is one broadcast for up to `goals_per_frame` servos."""

    def __init__(self, goals_per_frame: int = 8) -> None:
        self.goals_per_frame = goals_per_frame
        self.restarted: set[int] = set()
        self.refusal: Exception | None = None
        """What `plan` raises."""
        self.verifies = False
        """A question shows whether a servo has restarted: its register 0 reads `RESTARTED` then."""

    def fence(self, node: int, avoid: Sequence[Hashable], enabled: bool) -> Plan[bool]:
        number = next(number for number in range(256) if (PING | ANSWER, number) not in avoid)
        yield ToyRequest(node, PING, number)
        return node not in self.restarted

    def plan_goals(self, goals: Sequence[ServoGoal], *, together: bool, confirm: bool) -> list[GoalPlan]:
        if self.refusal is not None:
            raise self.refusal
        names = [goal.servo for goal in goals]
        size = len(names) if together else self.goals_per_frame
        parts = [tuple(names[at : at + size]) for at in range(0, len(names), size)]
        return [GoalPlan(part, self._say(part)) for part in parts]

    def verify(self, servos: Sequence[str]) -> Plan[Mapping[str, Loss]] | None:
        if not self.verifies:
            return None
        return self._verify(servos)

    def _verify(self, servos: Sequence[str]) -> Plan[Mapping[str, Loss]]:
        losses = {}
        for servo in servos:
            if (yield read(int(servo[1:]))) == RESTARTED:
                losses[servo] = Loss.RESTARTED
        return losses

    @staticmethod
    def _say(servos: tuple[str, ...]) -> Plan[dict[str, Outcome | Exception]]:
        yield shout(len(servos))
        return dict.fromkeys(servos, Outcome.SENT)


def ticket(number: int, ended: list[tuple[str, Any]], *, expires: float = 1.0, **traits: Any) -> Ticket:
    """A goal of servo `s<number>`; how it ends is put into `ended`."""
    servo = f"s{number}"
    return Ticket(
        ServoGoal(servo, Goal("position", 0.0)), number, expires, lambda result: ended.append((servo, result)), **traits
    )


class Sink:
    """The caller's end of a job: its results, in order."""

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
    """A scheduler with its nodes, without a line. All nodes are online."""

    def __init__(self, *nodes: int, online: bool = True, limit: int = QUEUE_LIMIT, goals_per_frame: int = 8) -> None:
        self.driver = ToyDriver(goals_per_frame)
        self.changes: list[tuple[int, Health, Health]] = []
        self.updates: list[Any] = []
        self.restarts: list[int] = []
        self.losses: list[tuple[str, Loss]] = []
        self.cuts: list[tuple[str, Exception]] = []
        self.nodes = NodeTable(nodes or (1, 2, 3), changed=self._changed)
        self.scheduler = Scheduler(
            cast("Driver", self.driver),
            self.nodes,
            enabled_servos=lambda node: (),
            on_update=self.updates.append,
            on_restart=lambda node: self.restarts.append(node.id),
            on_loss=lambda servo, loss: self.losses.append((servo, loss)),
            blind_stops=lambda node: [shout(node.id)],
            on_cut=lambda servo, error: self.cuts.append((servo, error)),
            on_setpoint=lambda servo, setpoint: None,
            goal_rate_hz=10.0,
            limit=limit,
        )
        if online:
            for node in list(self.nodes.by_id.values()):
                self.nodes.fenced(node)
            self.changes.clear()

    @property
    def coalescer(self) -> Coalescer:
        return self.scheduler.goals.coalescer

    def node(self, number: int) -> Node:
        return self.nodes.node(number)

    def take_offline(self, number: int, now: float = 0.0) -> None:
        while self.node(number).health is not Health.OFFLINE:
            self.nodes.missed(self.node(number), READ | ANSWER, now, now)

    def _changed(self, node: Node, before: Health) -> None:
        self.changes.append((node.id, before, node.health))
        self.scheduler.node_changed(node)


def poll(name: str, hz: float, *nodes: int) -> Poll:
    """One group read of those that are reachable."""

    def request(reachable: Collection[int]) -> ToyRequest | None:
        wanted = [node for node in nodes if node in reachable]
        return group_read(*wanted) if wanted else None

    return Poll(name, hz, nodes, request)
