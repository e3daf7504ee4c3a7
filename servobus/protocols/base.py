"""The words every protocol shares: requests that know their reply, codecs without I/O, plans, and what a driver offers.

Two rules hold for everything below this folder: no I/O and no clock. A codec is fed bytes and hands out replies; a plan is a
generator that yields requests and is sent what they returned, or has their error thrown into it. Whoever runs them owns the time.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Generator, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Protocol, TypeAlias, TypeVar

from servobus.errors import DeviceError, NotSupported, ServobusError
from servobus.values import Change, Identity, Outcome, ServoGoal, StopReport, StopTarget, Update

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
    turn: float = 0.0
    """What a tunnel takes for each turn, beside the bytes of the line behind it."""
    gap: float = 0.0
    """Silence before each frame."""
    can_change_baud: bool = False
    max_read: int | None = None
    """Registers that one read can bring through a tunnel; None: as many as the protocol has room for."""
    max_write: int | None = None
    """Registers that one write can carry through it, likewise."""

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
    mirrored: bool = False
    """The right answer is the request itself, said back: only for lines known to have no echo."""
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


@dataclass(frozen=True, slots=True)
class GoalPlan:
    """What the wire sees of some goals: one uninterrupted plan that ends in an outcome or an error per servo."""

    servos: tuple[str, ...]
    plan: Plan[dict[str, Outcome | Exception]]
    frames: int = 1


@dataclass(frozen=True, slots=True)
class Poll:
    """A read on a fixed grid: `request` makes it anew for the servos that are reachable, or None if none is."""

    name: str
    hz: float
    nodes: tuple[int, ...]
    request: Callable[[Collection[int]], Request[dict[str, Update]] | None]


class Commissioning(ABC):
    """Gives servos their ids and rates: one change at a time, read back, saved on request. For exclusive sessions."""

    commands: ClassVar[Mapping[str, str]]
    """Name of each maintenance command -> what it does to the node."""

    @abstractmethod
    def set_id(self, node: int, new: int, *, save: bool = False) -> Plan[Change]:
        """Return the plan that gives a node another id.

        Raises LimitError or NotSupported at once; the plan raises DeviceError where it suspects two servos with this id, or where
        `new` answers already.
        """

    @abstractmethod
    def set_baudrate(self, node: int, baudrate: int, *, save: bool = False) -> Plan[Change]:
        """Return the plan that gives a node another baud rate.

        Raises LimitError or NotSupported at once; the plan raises DeviceError where it suspects two servos with this id.
        """

    @abstractmethod
    def command(self, node: int, name: str, value: int | None = None) -> Plan[tuple[str, ...]]:
        """Return the plan of one of `commands`, which is sent once and never repeated. The plan returns notes for a person.

        Raises UnknownName or LimitError at once; the plan raises NotSupported or DeviceError.
        """

    def restarted(self, node: int) -> Plan[Any] | None:
        """Return the plan that finds out what became of a change that waited for this restart; None: nothing waited.

        The bus runs it when the node has restarted or is identified again.
        """
        return None


class Addressing(ABC):
    """Who is on the line."""

    nodes: Mapping[str, int]
    """Servo name -> id of the node that carries it."""

    @abstractmethod
    def ping(self, node: int) -> Request[int | None]:
        """Return the request whose reply shows that the node is there; its value is the status byte, if there is one."""

    @abstractmethod
    def unused(self) -> Request[Any]:
        """Return a request that no node answers: what comes back is the adapter's echo."""

    @abstractmethod
    def fence(self, node: int, avoid: Sequence[Hashable], enabled: Collection[str]) -> Plan[bool]:
        """Ask the node something whose reply cannot be confused with a late one.

        `avoid`: the reply keys that may still be under way, oldest first. `enabled`: the servos of this node that servobus has
        enabled. Returns False when one of those lost what `enable` wrote, so the node has restarted.
        """

    @abstractmethod
    def inspect(self, node: int) -> Plan[Identity]:
        """Ask a node who it is, whether it is configured or not."""

    @abstractmethod
    def identify(self, servo: str) -> Plan[Identity]:
        """Ask a configured servo who it is and whether it fits its options. Learns what the other verbs need; writes nothing."""


class Reading(ABC):
    """What servos tell."""

    @abstractmethod
    def read_state(self, servo: str) -> Request[dict[str, Update]]:
        """Return the request that brings every field of `State` the servo has, by servo name."""

    @abstractmethod
    def polls(self, rates: Mapping[str, float]) -> Sequence[Poll]:
        """Return the fewest reads that keep every servo's state fresh at these rates (Hz)."""

    @abstractmethod
    def read_register(self, servo: str, register: str, *, raw: bool = False) -> Request[Any]:
        """Return a read of the physical value, or of the integer with `raw`. Raises UnknownName, NotSupported."""

    def fault_names(self, servo: str, status: int | None) -> tuple[str, ...]:
        """Return the names of the faults in a status byte."""
        return ()

    def explain(self, servo: str, error: DeviceError) -> Plan[DeviceError] | None:
        """Return a plan that asks a servo why it refused, and returns the error to raise instead. None: no question."""
        return None


class Writing:
    """Settings."""

    def write_register(self, servo: str, register: str, value: Any, *, raw: bool = False, persist: bool = False) -> Plan[Any]:
        """Write and confirm; the plan returns the value that is then in the register.

        Raises LimitError, UnknownName, NotSupported before the first frame.
        """
        raise NotSupported("this protocol has no registers that can be written", servo=servo)


class Motion(ABC):
    """What moves servos and what stops them. A plan may be closed at any frame and must leave the servo safe."""

    @abstractmethod
    def step(self, servo: str) -> float:
        """Return the size of one raw step in the servo's unit."""

    @abstractmethod
    def enable(self, servo: str) -> Plan[float | None]:
        """Goal := present, then torque on, read back; returns the present position in the servo's unit."""

    @abstractmethod
    def disable(self, servo: str) -> Plan[StopReport]:
        """Torque off, read back."""

    @abstractmethod
    def stop(self, targets: Sequence[StopTarget]) -> Plan[dict[str, StopReport]]:
        """Stop servos: first everything that can be written at once, then what needs a question."""

    @abstractmethod
    def check_goal(self, goal: ServoGoal) -> Any:
        """Raise LimitError or NotSupported for what the model or the line cannot carry.

        Returns the goal packed for the wire, or None. The caller passes it on as `ServoGoal.packed`, and `plan_goals` uses it
        unless something has changed meanwhile. It is opaque to the caller.
        """

    @abstractmethod
    def plan_goals(self, goals: Sequence[ServoGoal], *, together: bool, confirm: bool) -> Sequence[GoalPlan]:
        """Return the fewest plans that carry these goals; with `together` one plan. Raises NotSupported."""

    def host_speed(self, goal: ServoGoal) -> float | None:
        """Return the speed (unit/s) that the host must keep on the way to this goal; None: the servo keeps its own."""
        return None


class Driver(Addressing, Reading, Writing, Motion, ABC):
    """A protocol on one bus: which requests each verb takes. Sans-IO; knows its servos by name and every node by id."""

    commissioning: Commissioning | None = None
    """None: this protocol's servos are given ids and rates with other tools."""

    def use_traits(self, traits: LineTraits) -> None:
        """Learn what the line carries; called before the first request."""

    def preview_goals(self, goals: Sequence[ServoGoal]) -> Sequence[Request[Any]]:
        """Return the frames that these goals take once the servos hold their settings. Changes no state, and asks nothing."""
        requests: list[Request[Any]] = []
        for _ in range(2 if goals else 0):
            requests.clear()
            for turn in self.plan_goals(goals, together=False, confirm=False):
                run_plan(turn.plan, requests.append)
        return requests

    def preview_stop(self, targets: Sequence[StopTarget]) -> Sequence[Request[Any]]:
        """Return the frames that a stop sends before it waits for a reply; where it cannot write to several servos at once, one
        request for each node. Changes no state, and asks nothing."""
        requests: list[Request[Any]] = []
        for request in self.stop(targets) if targets else ():
            if request.replies:
                return requests or [request] * len({self.nodes[target.servo] for target in targets})
            requests.append(request)
        return requests


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
