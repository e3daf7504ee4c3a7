"""The words every protocol shares: requests that know their reply, codecs without I/O, plans, and what a driver offers.

Two rules hold for everything below this folder: no I/O and no clock. A codec is fed bytes and hands out replies; a plan is a
generator that yields requests and is sent what they returned, or has their error thrown into it. Whoever runs them owns the time.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Generator, Hashable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Generic, Literal, Protocol, TypeAlias, TypeVar

R = TypeVar("R")
R_co = TypeVar("R_co", covariant=True)


@dataclass(frozen=True, slots=True)
class LineTraits:
    """What a link says of its line. Times in seconds."""

    baudrate: int | None = None
    """None: bytes take no time of their own (memory, TCP)."""
    paced: bool = False
    """Bytes really take their wire time, so whatever is heard before the request can have left is no answer to it."""
    latency: float = 0.0
    """What adapter, driver or tunnel add to every reply."""
    gap: float = 0.0
    """Silence before each frame."""
    can_change_baud: bool = False

    @property
    def byte_time(self) -> float:
        """Seconds of one byte, 8N1."""
        return 10.0 / self.baudrate if self.baudrate else 0.0


class Reply(Protocol):
    """One frame heard on the line."""

    @property
    def node(self) -> int:
        """The id the frame names."""

    @property
    def frame(self) -> bytes:
        """Its bytes as heard."""

    @property
    def key(self) -> Hashable:
        """What tells this reply from others of the same node; compare `Request.reply_key`."""

    @property
    def status(self) -> int | None:
        """The health byte, where the protocol has one in each reply."""


class Request(ABC, Generic[R]):
    """One thing to say, and everything about its answer. Immutable: one object may be sent many times."""

    node: int
    """The id addressed; the broadcast id for a broadcast."""
    frame: bytes
    """The bytes on the wire."""
    replies: int = 1
    """How many replies are due: 0 after a broadcast, several for a group read."""
    nodes: tuple[int, ...]
    """Which nodes answer; empty: any one."""
    reply_size: int = 0
    """Bytes of each reply frame."""
    reply_key: Hashable = None
    """What the reply looks like: two requests with the same key have replies that can be mistaken for each other."""
    idempotent: bool = True
    """May be said again when no answer came."""
    quiet_after: float = 0.0
    """Seconds of silence that must follow."""
    service_time: float = 0.0
    """Seconds the device may need beyond its usual delay (flash write, reboot)."""
    partial: bool = False
    """Fewer replies than due are a result too: the nodes that are missing become doubtful, the others are believed."""

    @abstractmethod
    def answers(self, reply: Any) -> bool:
        """Whether this reply, and no other, can be the answer (or one of the answers)."""

    @abstractmethod
    def parse(self, replies: Sequence[Any]) -> R:
        """The value of the replies, in the order heard. Raises DeviceError or EchoMismatch."""

    def plain(self) -> Request[R] | None:
        """The same question asked so that its own echo cannot be an answer; None where the echo never can."""
        return None


class Codec(Protocol):
    """Bytes in, replies out. One per bus."""

    def receive_data(self, data: bytes) -> None:
        """Append what was heard."""

    def next_reply(self) -> Reply | None:
        """The next whole valid frame; None: feed me more. Bytes that are no frame are skipped."""

    @property
    def pending(self) -> int:
        """Bytes heard that are no frame yet."""

    @property
    def skipped(self) -> int:
        """Bytes skipped since the beginning because they were no frame."""

    def reset(self) -> None:
        """Forget what was heard."""

    def describe(self, frame: bytes, *, sent: bool) -> str:
        """One line of words for a frame, for people."""


Plan: TypeAlias = Generator[Request[Any], Any, R]
"""Yields requests, is sent each one's value, and has its ServobusError thrown in. Its return value is the result."""


def ask(request: Request[R]) -> Plan[R]:
    """One request as a step of a plan, typed: `value = yield from ask(request)`."""
    value: R = yield request
    return value


def run_plan(plan: Plan[R], exchange: Callable[[Request[Any]], Any]) -> R:
    """Run a plan by a plain function: for tests, previews and simulated devices. Errors raised by it go into the plan."""
    from servobus.errors import ServobusError

    try:
        request = next(plan)
        while True:
            try:
                value = exchange(request)
            except ServobusError as error:
                request = plan.throw(error)
            else:
                request = plan.send(value)
    except StopIteration as stop:
        result: R = stop.value
        return result


class Outcome(StrEnum):
    """How a goal ended that did not fail."""

    ACKED = "acked"
    """The servo confirmed it."""
    SENT = "sent"
    """It left, and the protocol has no answer to it."""
    SUPERSEDED = "superseded"
    """A newer goal of the same servo took its place before it left."""


GoalKind: TypeAlias = Literal["position", "velocity"]


@dataclass(frozen=True, slots=True)
class Goal:
    """Where a servo shall go. Positions in the servo's unit, speeds in unit/s, times in seconds."""

    kind: GoalKind
    value: float
    speed: float | None = None
    """Unit/s on the way; None: the servo's own setting."""
    duration: float | None = None
    """Seconds the way shall take; not together with speed."""
    acceleration: float | None = None
    """Unit/s^2; None: the servo's own setting."""
    effort: float | None = None
    """Percent of the greatest torque."""
    deadline: float | None = None
    """Seconds from acceptance within which its first byte must leave; None: the servo's `ttl`."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """position = direction * (raw - zero) * unit_per_step, as DESIGN section 7 rules."""

    zero: float
    direction: int
    unit_per_step: float

    def to_unit(self, raw: float) -> float:
        return self.direction * (raw - self.zero) * self.unit_per_step + 0.0  # never -0.0

    def to_raw(self, position: float) -> int:
        """Nearest step, ties to even."""
        return round(self.zero + self.direction * position / self.unit_per_step)

    def rate_to_unit(self, steps: float) -> float:
        """Steps/s to unit/s, with the direction."""
        return self.direction * steps * self.unit_per_step + 0.0

    def rate_to_raw(self, rate: float) -> float:
        """Unit/s to steps/s, with the direction, not rounded."""
        return self.direction * rate / self.unit_per_step


Update: TypeAlias = dict[str, Any]
"""Fields of `State` as one reply brought them."""


@dataclass(frozen=True, slots=True)
class State:
    """What is known of a servo. Absent is None. Position, goal in its unit; speed unit/s; load %; A; V; Celsius."""

    position: float | None = None
    goal: float | None = None
    speed: float | None = None
    load: float | None = None
    current: float | None = None
    voltage: float | None = None
    temperature: float | None = None
    moving: bool | None = None
    enabled: bool = False
    faults: tuple[str, ...] = ()
    status: int | None = None
    health: str = "offline"
    """online, doubtful or offline."""
    time: float | None = None
    """Monotonic seconds of the newest field."""
    age: float | None = None
    """Seconds since `time` when this was made."""


@dataclass(frozen=True, slots=True)
class Identity:
    """What a servo says of itself; None where the protocol does not tell."""

    model: str | None = None
    """Name of a model file that fits."""
    product: str | None = None
    firmware: str | None = None
    mode: GoalKind | None = None
    energised: bool | None = None
    limits: tuple[float, float] | None = None
    """The servo's own stored limits, in its unit."""
    notes: tuple[str, ...] = ()
    """What a person should know: settings that do not fit the config."""


@dataclass(frozen=True, slots=True)
class ServoGoal:
    """One goal of one servo, checked, on its way to the wire."""

    servo: str
    goal: Goal
    start: float | None = None
    """The last known position, for a duration that has to become a speed."""


@dataclass(frozen=True, slots=True)
class GoalTurn:
    """What the wire sees of some goals: one uninterrupted plan that ends in an outcome or an error per servo."""

    servos: tuple[str, ...]
    plan: Plan[dict[str, Outcome | Exception]]
    frames: int = 1


@dataclass(frozen=True, slots=True)
class StopTarget:
    """A servo an e-stop must reach."""

    servo: str
    kind: Literal["hold", "limp"]
    enabled: bool
    """Enabled by us; None is not known here: an unenabled servo is asked before it is held."""
    position: float | None = None
    """The present position, if it is fresh enough to be written at once."""
    reachable: bool = True
    """False: known to be offline; it is written to, and not waited for."""


@dataclass(frozen=True, slots=True)
class StopReport:
    """What an e-stop, a disable or an exit did to one servo."""

    action: str
    """hold, limp, park, or none (it was limp already)."""
    written: bool
    confirmed: bool
    detail: str = ""


@dataclass(frozen=True, slots=True)
class Poll:
    """A read on a fixed grid: `request` makes it anew for the servos that are reachable, or None if none is."""

    name: str
    hz: float
    nodes: tuple[int, ...]
    request: Callable[[Collection[int]], Request[dict[str, Update]] | None]


class Driver(Protocol):
    """A protocol's verbs on one bus: what to say for each. Sans-IO; knows its servos by name and every node by id."""

    @property
    def nodes(self) -> Mapping[str, int]:
        """Servo name to node."""

    def step(self, servo: str) -> float:
        """The size of one raw step in the servo's unit."""

    def ping(self, node: int) -> Request[int | None]:
        """Is it there? Its status byte, if it has one."""

    def unused(self) -> Request[Any]:
        """A question nobody answers, to hear whether the line echoes."""

    def recover(self, node: int, avoid: Sequence[Hashable], enabled: bool) -> Plan[bool]:
        """Fence: ask what cannot be mistaken for any reply in `avoid` (oldest first). False: a servo of the node lost
        what enable() wrote, so it has restarted (asked only when `enabled`)."""

    def inspect(self, node: int) -> Plan[Identity]:
        """Who is there, whether configured or not."""

    def identify(self, servo: str) -> Plan[Identity]:
        """Who is there, and whether it fits the config. Learns what the other verbs need to know; writes nothing."""

    def read_state(self, servo: str) -> Request[dict[str, Update]]:
        """Everything `State` can hold, by servo name."""

    def polls(self, rates: Mapping[str, float]) -> Sequence[Poll]:
        """The fewest reads that keep every servo's state fresh at these rates (Hz)."""

    def read_register(self, servo: str, register: str, *, raw: bool = False) -> Request[Any]:
        """Physical value, or the integer with `raw`. Raises UnknownName, NotSupported."""

    def write_register(self, servo: str, register: str, value: Any, *, raw: bool = False, persist: bool = False) -> Plan[Any]:
        """Write and confirm; the value then in the register. Raises LimitError, UnknownName, NotSupported at once."""

    def enable(self, servo: str) -> Plan[float | None]:
        """Goal := present, then torque on; the present position, in the servo's unit."""

    def disable(self, servo: str) -> Plan[StopReport]:
        """Torque off, confirmed."""

    def stop(self, targets: Sequence[StopTarget]) -> Plan[dict[str, StopReport]]:
        """The shortest way to stillness: first everything that can be written at once, then what needs a question."""

    def check_goal(self, goal: ServoGoal) -> None:
        """Raise LimitError or NotSupported for what the model or the wire cannot carry."""

    def plan(self, goals: Sequence[ServoGoal], *, together: bool, confirm: bool) -> Sequence[GoalTurn]:
        """The fewest turns that carry these goals; with `together` one turn. Raises NotSupported."""

    def fault_names(self, servo: str, status: int | None) -> tuple[str, ...]:
        """The words for a health byte."""


@dataclass(frozen=True, slots=True)
class DeviceReply:
    """What a simulated device says: after `delay` seconds from the end of the request, and after the replies of lower slots."""

    data: bytes
    delay: float = 0.0
    slot: int = 0
    late: float = 0.0
    """More delay, that of a fault: it stays even on a line whose bytes take no time."""


class Device(Protocol):
    """A simulated node: the same frames and the same register map, from the other end. Sans-IO; it is told the time."""

    @property
    def node(self) -> int: ...

    @property
    def baudrate(self) -> int:
        """It hears nothing that is said at another rate."""

    def handle(self, packet: Any, now: float) -> Sequence[DeviceReply]:
        """A whole valid frame was on the line (for this node or another); `now` in monotonic seconds."""


def is_number(value: object) -> bool:
    """A finite number that is no boolean."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer no float can hold
        return False
