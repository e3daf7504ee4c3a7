"""The interfaces of a protocol: request, reply, codec, plan, and the roles of a driver. `docs/writing-a-driver.md` explains them.

Nothing in this package does I/O or knows the time. A codec receives bytes and returns replies. A plan is a generator that yields
requests and is sent their values, or has their errors thrown in. The engine runs plans and owns the time.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Generator, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Protocol, TypeAlias, TypeVar

from servobus.errors import DeviceError, NotSupported, ServobusError
from servobus.values import Change, Identity, Loss, Outcome, ServoGoal, StopReport, StopTarget, Update

R = TypeVar("R")


@dataclass(frozen=True, slots=True)
class LineTraits:
    """What a link knows about its line. Times in seconds."""

    baudrate: int | None = None
    """None: bytes take no time of their own (memory, TCP)."""
    paced: bool = False
    """Bytes really take their wire time, so bytes received before the request can have left are not a reply to it."""
    latency: float = 0.0
    """Delay that adapter, driver or tunnel add to every reply."""
    turn: float = 0.0
    """Time that a tunnel needs for each turn, beside the bytes of the line behind it."""
    gap: float = 0.0
    """Silence before each frame."""
    can_change_baud: bool = False
    max_read: int | None = None
    """Registers that one read can bring through a tunnel; None: as many as the protocol allows."""
    max_write: int | None = None
    """Registers that one write can carry through a tunnel, likewise."""

    @property
    def byte_time(self) -> float:
        """Seconds of one byte, 8N1."""
        return 10.0 / self.baudrate if self.baudrate else 0.0


class Reply(Protocol):
    """One valid frame received from the line."""

    @property
    def node(self) -> int:
        """The id in the frame."""

    @property
    def frame(self) -> bytes:
        """The bytes of the frame."""

    @property
    def key(self) -> Hashable:
        """What distinguishes this reply from others of the same node; see `Request.reply_key`."""

    @property
    def status(self) -> int | None:
        """The health byte; None: replies of this protocol have none."""


class Request(ABC, Generic[R]):
    """One request, and everything about its replies. Immutable: one object may be sent many times."""

    node: int
    """The id it is addressed to; the broadcast id for a broadcast."""
    frame: bytes
    """The bytes on the wire."""
    replies: int = 1
    """How many replies are due: 0 after a broadcast, several for a group read."""
    nodes: tuple[int, ...]
    """The nodes that answer; empty: any one."""
    reply_size: int = 0
    """Bytes of each reply frame."""
    reply_key: Hashable = None
    """Two requests with the same key have replies that can be mistaken for each other."""
    idempotent: bool = True
    """It may be sent again when no reply came."""
    changes: bool = True
    """It asks the device to change something, which may be done where no reply came."""
    quiet_after: float = 0.0
    """Seconds of silence that must follow the request."""
    service_time: float = 0.0
    """Seconds the device may need beyond its usual delay (flash write, reboot)."""
    mirrored: bool = False
    """The right reply has the same bytes as the request: only for lines that are known to have no echo."""
    relayed: bool = False
    """A gateway may reply in the node's name: see `is_silence`."""
    partial: bool = False
    """Fewer replies than due are a result too: the missing nodes become doubtful, the others are believed."""

    @abstractmethod
    def answers(self, reply: Any) -> bool:
        """Return whether this can be the reply, or one of the replies."""

    @abstractmethod
    def parse(self, replies: Sequence[Any]) -> R:
        """Return the value of the replies, which are in the order received. Raises DeviceError or EchoMismatch."""

    def is_silence(self, replies: Sequence[Any]) -> bool:
        """Return whether these replies, of a `relayed` request, say that the node did not answer the gateway."""
        return False

    def whole_reply(self, data: bytes) -> Any:
        """Return the reply if these bytes are exactly the one reply that is due; None: the codec has to decide.

        A short cut of the hot path. It must make the same checks as the codec and `answers`, and return the same reply.
        """
        return None

    def plain(self) -> Request[R] | None:
        """Return a request for the same value whose echo cannot be its reply; None: the echo of this one never can."""
        return None


class Codec(Protocol):
    """Finds replies in a stream of bytes. One per bus; `protocols.stream.StreamCodec` is the usual base."""

    def receive_data(self, data: bytes) -> None:
        """Append received bytes."""

    def next_reply(self) -> Reply | None:
        """Return the next whole valid frame; None: more bytes are needed. Bytes that belong to no frame are skipped."""

    @property
    def pending(self) -> int:
        """Bytes received that are no frame yet."""

    @property
    def skipped(self) -> int:
        """Bytes skipped since the beginning because they belong to no frame."""

    def reset(self) -> None:
        """Forget the received bytes."""

    def describe(self, frame: bytes, *, sent: bool) -> str:
        """Return one line of text about a frame, for people."""


Plan: TypeAlias = Generator[Request[Any], Any, R]
"""Yields requests, is sent each one's value, and has its ServobusError thrown in. Its return value is the result."""


def ask(request: Request[R]) -> Plan[R]:
    """Make one request a step of a plan, with its type: `value = yield from ask(request)`."""
    value: R = yield request
    return value


def run_plan(plan: Plan[R], exchange: Callable[[Request[Any]], Any]) -> R:
    """Run a plan with a plain function, for tests. A ServobusError that the function raises goes into the plan."""
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
    """The plan that carries some goals, uninterrupted but for an e-stop. It returns an outcome or an error for each servo."""

    servos: tuple[str, ...]
    plan: Plan[dict[str, Outcome | Exception]]
    frames: int = 1


@dataclass(frozen=True, slots=True)
class Poll:
    """A read at a fixed rate. `request` returns it for the nodes that are reachable; None: nothing is to be read."""

    name: str
    hz: float
    nodes: tuple[int, ...]
    request: Callable[[Collection[int]], Request[dict[str, Update]] | None]


def single_polls(
    rates: Mapping[str, float], nodes: Mapping[str, int], read: Callable[[str, str], Request[dict[str, Update]]]
) -> list[Poll]:
    """Return a poll for each rate and servo, where one request asks one servo: `read(name of the rate, name of the servo)`."""

    def poll(name: str, hz: float, servo: str, node: int) -> Poll:
        request = read(name, servo)
        return Poll(name, hz, (node,), lambda reachable: request if node in reachable else None)

    return [poll(name, hz, servo, node) for name, hz in rates.items() for servo, node in nodes.items()]


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
        """Return the request whose reply shows that the node is there; its value is the status byte, or None."""

    @abstractmethod
    def unused(self) -> Request[Any]:
        """Return a request that no node answers, so that all bytes received after it are the adapter's echo."""

    @abstractmethod
    def fence(self, node: int, avoid: Sequence[Hashable], enabled: Collection[str]) -> Plan[bool]:
        """Return the plan that makes a node believable again; see `protocols.fence`.

        Args:
            avoid: the reply keys that may still be under way, oldest first; the fence's own reply must have another.
            enabled: the servos of this node that are enabled. The plan returns False when one of them lost what `enable` wrote,
                because then the node has restarted.
        """

    @abstractmethod
    def inspect(self, node: int) -> Plan[Identity]:
        """Return the plan that asks any node, configured or not, who it is."""

    @abstractmethod
    def identify(self, servo: str) -> Plan[Identity]:
        """Return the plan that asks a configured servo who it is and notes what does not fit its options.

        It learns what the other verbs need (mode, limits, register map), and writes nothing.
        """


class Reading(ABC):
    """What servos report."""

    @abstractmethod
    def read_state(self, servo: str) -> Request[dict[str, Update]]:
        """Return the request that brings the fields of `State` that one turn can bring, by servo name."""

    @abstractmethod
    def polls(self, rates: Mapping[str, float]) -> Sequence[Poll]:
        """Return the fewest reads that keep every servo's state fresh. `rates`: `feedback` and `health` -> Hz."""

    @abstractmethod
    def read_register(self, servo: str, register: str, *, raw: bool = False) -> Request[Any]:
        """Return the read of a register's physical value, or of its integer with `raw`. Raises UnknownName, NotSupported."""

    def fault_names(self, servo: str, status: int | None) -> tuple[str, ...]:
        """Return the names of the faults in a status byte."""
        return ()

    def explain(self, servo: str, error: DeviceError) -> Plan[DeviceError] | None:
        """Return the plan that asks a servo why it refused and returns the error to raise instead; None: it cannot be asked."""
        return None


class Writing:
    """Settings."""

    def write_register(self, servo: str, register: str, value: Any, *, raw: bool = False, persist: bool = False) -> Plan[Any]:
        """Return the plan that writes a register and returns the value that it has then.

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
        """Return the plan: goal := present, torque on, both read back. Its value is the present position in the servo's unit.

        The joint must not move. The plan raises NotSupported where it would, and ends with torque off when it fails half-way.
        """

    @abstractmethod
    def disable(self, servo: str) -> Plan[StopReport]:
        """Return the plan: torque off, read back."""

    @abstractmethod
    def stop(self, targets: Sequence[StopTarget]) -> Plan[dict[str, StopReport]]:
        """Return the plan that stops servos: first everything that can be written at once, then everything that needs a reply.

        One servo that does not answer must not delay the others by more than its own turn.
        """

    def verify(self, servos: Sequence[str]) -> Plan[Mapping[str, Loss]] | None:
        """Return the plan that finds out which of these enabled servos are not as they were left, in the fewest turns.

        It comes before a goal whose servo was not verified lately: a goal would energise a servo that has restarted. Its value
        names those alone. A servo that does not answer becomes doubtful as after any request; the plan raises nothing for it.
        None, the default: no question shows that.
        """
        return None

    def blind_stop(self, target: StopTarget) -> Sequence[Request[Any]]:
        """Return the frames that stop a servo that does not answer, as far as that can be done without asking it.

        They need no reply, may be sent again and again, and must not make a servo travel or energise it that has restarted
        meanwhile: torque off, speed 0. Nothing where there is no such frame (a hold needs the present position).
        """
        return ()

    @abstractmethod
    def check_goal(self, goal: ServoGoal) -> Any:
        """Raise LimitError or NotSupported for what the model or the line cannot carry.

        Returns the goal packed for the wire, or None. The caller passes it on as `ServoGoal.packed`, and `plan_goals` uses it
        unless something has changed meanwhile. It is opaque to the caller.
        """

    @abstractmethod
    def plan_goals(self, goals: Sequence[ServoGoal], *, together: bool, confirm: bool) -> Sequence[GoalPlan]:
        """Return the fewest plans that carry these goals. Raises NotSupported.

        Args:
            together: the servos start at the same moment, so all goals are in one plan.
            confirm: each goal is acknowledged by its servo.
        """

    @abstractmethod
    def preview_goals(self, goals: Sequence[ServoGoal]) -> Sequence[Request[Any]]:
        """Return the frames that these goals take once the servos hold their settings. Changes no state, and asks nothing."""

    @abstractmethod
    def preview_stop(self, targets: Sequence[StopTarget]) -> Sequence[Request[Any]]:
        """Return the frames of a stop that goes well, up to the last one that stops a servo: the questions too.

        Changes no state, and asks nothing.
        """

    def host_speed(self, goal: ServoGoal) -> float | None:
        """Return the speed (unit/s) that the host must keep on the way to this goal; None: the servo keeps its own."""
        return None


class Driver(Addressing, Reading, Writing, Motion, ABC):
    """A protocol on one bus: the requests of each verb. Sans-IO; it knows its servos by name and every node by id."""

    commissioning: Commissioning | None = None
    """None: this protocol's servos are given ids and rates with other tools."""

    def use_traits(self, traits: LineTraits) -> None:
        """Learn what the line can carry; called before the first request."""

    def use_options(self, options: Any) -> bool:
        """Take the options of a config that was read again, with the same line, ids and models; return whether that is done.

        Called between two turns, also while servos are enabled. What was learned of the servos remains. False, the default: the
        bus has to be opened again.
        """
        return False
