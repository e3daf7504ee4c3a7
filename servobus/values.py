"""What is said about servos, whatever their protocol: goals and their outcomes, states, identities, stops. Plain frozen data.

Positions are in the servo's unit, speeds in unit/s, times in seconds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum, StrEnum
from typing import Any, Literal, Self, TypeAlias

from servobus.errors import UnknownName


class Described(StrEnum):
    """A string enum whose members say in one sentence what they mean: `NAME = "name", "One sentence."`."""

    description: str

    def __new__(cls, value: str, description: str = "") -> Self:
        member = str.__new__(cls, value)
        member._value_ = value
        member.description = description
        return member


class EventName(StrEnum):
    """Every event of a rig: `NAME = "name", "One sentence.", "its fields"`."""

    description: str
    fields: tuple[str, ...]
    """What `Event.fields` holds."""

    def __new__(cls, value: str, description: str = "", fields: str = "") -> Self:
        member = str.__new__(cls, value)
        member._value_ = value
        member.description = description
        member.fields = tuple(fields.split())
        return member

    LINE_UP = "line_up", "The line of a bus was opened.", "bus port"
    LINE_DOWN = "line_down", "The line of a bus ended: its port is gone or its connection broke.", "bus port"
    WAITING_FOR_PORT = "waiting_for_port", "The port cannot be opened for this reason, and is tried again.", "bus port reason"
    ECHO_PROBED = "echo_probed", "The bus found out whether the line echoes what it sends.", "bus echo"
    SERVO_ONLINE = "servo_online", "The node answers again.", "bus servo id"
    SERVO_DOUBTFUL = "servo_doubtful", "A reply of the node is missing or came unasked.", "bus servo id"
    SERVO_OFFLINE = "servo_offline", "The node missed several replies in a row.", "bus servo id"
    SERVO_MISSING = "servo_missing", "A configured node did not answer when the line was opened.", "bus servo id reason"
    SERVO_NOTE = "servo_note", "A setting of the servo does not fit the config.", "bus servo note"
    SERVO_RESTARTED = "servo_restarted", "The servo restarted: it lost its torque and its volatile settings.", "bus servo id"
    MOTION_CUT = "motion_cut", "Motion that was under way was ended.", "bus servo reason"
    GOAL_CLAMPED = "goal_clamped", "A goal was moved to the limit (`on_limit: clamp`).", "bus servo asked applied"
    PARK_UNCONFIRMED = "park_unconfirmed", "A servo was to be parked, and it is not confirmed that it was.", "bus servo detail"
    EXIT_UNCONFIRMED = "exit_unconfirmed", "What `on_exit` asks for is not confirmed.", "bus servo action detail"
    ESTOP = "estop", "The e-stop was asked for; it is latched.", ""
    ESTOP_CLEARED = "estop_cleared", "The e-stop was released.", ""
    RELOADED = "reloaded", "The config was read again: these buses are new, changed or gone.", "added changed removed"
    LEASE_LOST = "lease_lost", "A client lost its motion leases; its servos do their `on_lost_client`.", "client servos reason"
    DAEMON_LOST = "daemon_lost", "The connection to the daemon ended (seen by this client alone).", "reason"
    DAEMON_BACK = "daemon_back", "The connection to the daemon is back (seen by this client alone).", ""


class Outcome(StrEnum):
    """How a goal ended that did not fail."""

    ACKED = "acked"
    """The servo confirmed it."""
    SENT = "sent"
    """It left, and the protocol has no answer to it."""
    SUPERSEDED = "superseded"
    """A newer goal of the same servo took its place before it left."""


class Health(StrEnum):
    """What servobus believes of a node."""

    ONLINE = "online"
    """It answers what it is asked."""
    DOUBTFUL = "doubtful"
    """A reply is missing or came unasked; a fence comes before the next request to it."""
    OFFLINE = "offline"
    """It missed several replies in a row. It is probed with growing pauses, and nobody waits for it."""


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
    start_within: float | None = None
    """Seconds from acceptance within which its first byte must leave; None: the servo's `ttl`."""


GOAL_NUMBERS = ("value", "speed", "duration", "acceleration", "effort", "start_within")
"""The fields of a goal that are finite numbers; all but `value` may be None."""


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
    health: Health = Health.OFFLINE
    """Whether its node answers."""
    time: float | None = None
    """Monotonic seconds of the newest field."""
    age: float | None = None
    """Seconds since `time` when this was made."""


Snapshot = dict[str, State]
"""The last known state of every servo, by full name."""


@dataclass(frozen=True, slots=True)
class ScanHit:
    """A node that answered a scan.

    Attributes:
        bus: Name of the bus.
        id: The id that answered.
        baudrate: The baud rate at which it answered, in bit/s.
        model: Name of a model file that fits; None: none does.
        product: What the node calls itself; None: the protocol has no such register.
        firmware: Its firmware version; None: the protocol has no such register.
        note: What a person should know.
    """

    bus: str
    id: int
    baudrate: int
    model: str | None
    product: str | None
    firmware: str | None
    note: str = ""


@dataclass(frozen=True, slots=True)
class Reload:
    """What reading the config again changed, as names of buses.

    Attributes:
        added: Buses that are new.
        changed: Buses that were left as at exit and opened again; their servos are not enabled.
        removed: Buses that are gone.
    """

    added: tuple[str, ...] = ()
    changed: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()


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
    packed: Any = field(default=None, compare=False, repr=False)
    """What `Driver.check_goal` returned for this goal, so that it is not packed twice; None: it was not checked yet."""


@dataclass(frozen=True, slots=True)
class StopTarget:
    """A servo an e-stop must reach."""

    servo: str
    kind: Literal["hold", "limp"]
    enabled: bool
    """Enabled by us; one that is not is asked whether its torque is on before it is held."""
    position: float | None = None
    """The present position, if it is fresh enough to be written at once."""
    setpoint: float | None = None
    """The last position that was sent or held; None: not known."""
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
class Change:
    """What was changed, and whether the servo goes by it already."""

    node: int
    """Where it was changed."""
    what: Literal["id", "baudrate"]
    value: int
    saved: bool = False
    pending_reboot: bool = True
    """It takes effect when the servo is saved and restarted; until then it answers as before."""
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        step = "restart the servo" if self.saved else "save and restart the servo"
        return f"pending_reboot: {self.what} {self.value} is set and not in effect yet: {step}"


class Role(IntEnum):
    """In the order of what they may."""

    NOBODY = 0
    """Has not shown a token yet."""
    OBSERVER = 1
    """Reads, and stops: anyone may stop."""
    OPERATOR = 2
    """Moves."""
    ADMIN = 3
    """Changes what stays: ids, rates, EEPROM, the config."""

    def __str__(self) -> str:
        return self.name.lower()


def is_number(value: object) -> bool:
    """A finite number that is no boolean."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer no float can hold
        return False


def no_number(what: str, value: object) -> str:
    """What to say of a value that `is_number` refuses."""
    huge = isinstance(value, int) and not isinstance(value, bool)  # Python itself refuses to print it
    return f"{what}: {'a huge integer' if huge else repr(value)[:40]} is not a finite number"


def known_command(commands: Mapping[str, str], name: str) -> str:
    """What it does. Raises UnknownName."""
    if name not in commands:
        raise UnknownName(f"no command {name!r}: there are {', '.join(f'{each} ({what})' for each, what in commands.items())}")
    return commands[name]
