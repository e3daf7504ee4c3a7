"""The values that every package shares, whatever the protocol: goals and outcomes, states, identities, stops. Plain frozen data.

Positions are in the servo's unit (degrees unless its model or its config says otherwise), speeds in unit/s, times in seconds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum, StrEnum
from typing import Any, Literal, Self, TypeAlias

from servobus.errors import UnknownName


class Described(StrEnum):
    """A string enum whose members say in one sentence what they mean: `NAME = "name", "One sentence.", "its fields"`."""

    description: str
    fields: tuple[str, ...]
    """Names of what comes with a member; of an event, what `Event.fields` holds."""

    def __new__(cls, value: str, description: str = "", fields: str = "") -> Self:
        member = str.__new__(cls, value)
        member._value_ = value
        member.description = description
        member.fields = tuple(fields.split())
        return member


class EventName(Described):
    """Every event of a rig: `NAME = "name", "One sentence.", "its fields"`."""

    LINE_UP = "line_up", "The line of a bus was opened.", "bus port"
    LINE_DOWN = "line_down", "The line of a bus ended: its port is gone or its connection broke.", "bus port"
    WAITING_FOR_PORT = "waiting_for_port", "The port cannot be opened for this reason, and is tried again.", "bus port reason"
    ECHO_PROBED = "echo_probed", "The bus found out whether the line echoes what it sends.", "bus echo"
    SERVO_ONLINE = "servo_online", "The node answers again.", "bus servo id"
    SERVO_DOUBTFUL = "servo_doubtful", "A reply of the node is missing or came unasked.", "bus servo id"
    SERVO_FAILING = "servo_failing", "The node answers, and refuses what the polls ask, for this reason.", "bus servo id reason"
    SERVO_OFFLINE = "servo_offline", "The node missed several replies in a row.", "bus servo id"
    SERVO_MISSING = "servo_missing", "A configured node did not answer when the line was opened.", "bus servo id reason"
    SERVO_NOTE = "servo_note", "A setting of the servo does not fit the config.", "bus servo note"
    SERVO_RESTARTED = "servo_restarted", "The servo restarted: it lost its torque and its volatile settings.", "bus servo id"
    TORQUE_LOST = "torque_lost", "The torque of an enabled servo is off, and not by us; the servo is disabled.", "bus servo id"
    STOP_OWED = "stop_owed", "A stop is not confirmed; it is repeated until the servo confirms it.", "bus servo action detail"
    STOP_PAID = "stop_paid", "A stop that was owed is confirmed.", "bus servo action"
    MOTION_CUT = "motion_cut", "Motion that was under way was ended.", "bus servo reason"
    GOAL_CLAMPED = "goal_clamped", "A goal was moved to the limit (`on_limit: clamp`).", "bus servo asked applied"
    PARK_UNCONFIRMED = "park_unconfirmed", "A servo was to be parked, and it is not confirmed that it was.", "bus servo detail"
    EXIT_UNCONFIRMED = "exit_unconfirmed", "What `on_exit` asks for is not confirmed.", "bus servo action detail"
    ESTOP = "estop", "The e-stop was asked for; it is latched.", ""
    ESTOP_CLEARED = "estop_cleared", "The e-stop was released; these servos still owe a stop.", "owed"
    RELOADED = "reloaded", "The config was read again: what became of the buses that differ.", "added changed removed updated"
    LEASE_LOST = "lease_lost", "A client lost its motion leases; its servos do their `on_lost_client`.", "client servos reason"
    DAEMON_LOST = "daemon_lost", "The connection to the daemon ended (seen by this client alone).", "reason"
    DAEMON_BACK = "daemon_back", "The connection to the daemon is back (seen by this client alone).", ""


class Outcome(StrEnum):
    """How a goal ended that did not fail.

    ACKED: the servo confirmed it. SENT: it was sent, and the protocol has no reply to it. SUPERSEDED: a newer goal of the same
    servo replaced it before it was sent.
    """

    ACKED = "acked"
    SENT = "sent"
    SUPERSEDED = "superseded"


class Health(Described):
    """Whether a node answers.

    ONLINE: it answers. DOUBTFUL: a reply is missing or came unasked. FAILING: it refuses what it is asked. OFFLINE: it missed
    several replies in a row.
    """

    ONLINE = "online", "The node answers what it is asked."
    DOUBTFUL = "doubtful", "A reply is missing or came unasked; a fence comes before the next request to the node."
    FAILING = "failing", "The node answers, and has refused what the polls ask several times in a row."
    OFFLINE = "offline", "The node missed several replies in a row; it is probed with growing pauses, and nothing waits for it."


class Loss(Described):
    """How an enabled servo can turn out not to be as it was left: see `Motion.verify`."""

    RESTARTED = "restarted", "The servo restarted: its volatile settings are gone."
    TORQUE_OFF = "torque_off", "Its torque is off, and not by us: a protection of the servo or another program switched it off."


GoalKind: TypeAlias = Literal["position", "velocity"]


@dataclass(frozen=True, slots=True)
class Goal:
    """Where a servo is to go.

    Attributes:
        kind: "position" or "velocity".
        value: The position in the servo's unit, or the velocity in unit/s (the sign is the direction).
        speed: Speed on the way, in unit/s; None: the servo's own.
        duration: Seconds the motion is to take; not together with `speed`.
        acceleration: In unit/s^2; None: the servo's own.
        effort: In percent of the greatest torque; None: the servo's own.
        start_within: Seconds within which the first byte must leave; None: the servo's `ttl`.
    """

    kind: GoalKind
    value: float
    speed: float | None = None
    duration: float | None = None
    acceleration: float | None = None
    effort: float | None = None
    start_within: float | None = None


GOAL_NUMBERS = ("value", "speed", "duration", "acceleration", "effort", "start_within")
"""The fields of a goal that are finite numbers; all but `value` may be None."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """position = direction * (raw - zero) * unit_per_step, with raw in steps."""

    zero: float
    direction: int
    unit_per_step: float

    def to_unit(self, raw: float) -> float:
        return self.direction * (raw - self.zero) * self.unit_per_step + 0.0  # never -0.0

    def to_raw(self, position: float) -> int:
        """The nearest step, ties to even."""
        return round(self.zero + self.direction * position / self.unit_per_step)

    def rate_to_unit(self, steps: float) -> float:
        """Steps/s to unit/s, with the direction."""
        return self.direction * steps * self.unit_per_step + 0.0

    def rate_to_raw(self, rate: float) -> float:
        """Unit/s to steps/s, with the direction, not rounded."""
        return self.direction * rate / self.unit_per_step


Update: TypeAlias = dict[str, Any]
"""Fields of `State` that one reply brought. `loss` beside them: what the reply says about a servo that is enabled, a `Loss`, or
None where it is as it was left; absent: the reply says nothing about that."""


@dataclass(frozen=True, slots=True)
class State:
    """What is known of a servo. A field that is not known is None.

    Attributes:
        position: In the servo's unit.
        goal: The position that the servo itself holds as its goal, in its unit.
        speed: In unit/s, with the direction.
        load: In percent of the greatest torque, with the direction.
        current: In A, with the direction.
        voltage: In V.
        temperature: In degrees Celsius.
        moving: Whether the servo says that it moves.
        enabled: Whether its torque was switched on here.
        energised: Whether its torque was on when it was read, whoever switched it on; None: its protocol does not tell.
        faults: Names of the faults that it reports.
        status: The status byte from which they are taken.
        health: Whether its node answers.
        time: Monotonic seconds when the position was read; those of the newest field where it never was.
        age: Seconds from `time` to when this State was made.
    """

    position: float | None = None
    goal: float | None = None
    speed: float | None = None
    load: float | None = None
    current: float | None = None
    voltage: float | None = None
    temperature: float | None = None
    moving: bool | None = None
    enabled: bool = False
    energised: bool | None = None
    faults: tuple[str, ...] = ()
    status: int | None = None
    health: Health = Health.OFFLINE
    time: float | None = None
    age: float | None = None


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
        updated: Buses that go on without a pause, with new rates, limits, speeds or policies.
    """

    added: tuple[str, ...] = ()
    changed: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()
    updated: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Identity:
    """What a servo says of itself. A field that its protocol does not have is None.

    Attributes:
        model: Name of a model file that fits.
        product: Its product name or number.
        firmware: Its firmware version.
        mode: "position", "velocity", or another mode by its name ("pwm", "step", "motor", "mode 7"), in which it takes no goal.
        energised: Whether its torque is on, whoever switched it on.
        limits: Its own stored limits, in its unit.
        notes: Settings that do not fit the config, for a person.
        obstacle: Why it must not be moved; empty: it may be moved.
    """

    model: str | None = None
    product: str | None = None
    firmware: str | None = None
    mode: str | None = None
    energised: bool | None = None
    limits: tuple[float, float] | None = None
    notes: tuple[str, ...] = ()
    obstacle: str = ""


@dataclass(slots=True)
class ServoGoal:
    """One goal of one servo, on its way to the wire. Only `packed` and `applied` are set later."""

    servo: str
    goal: Goal
    start: float | None = None  # the last known position, for a duration that has to become a speed
    lead: float | None = None
    """How far ahead of where the servo is read this setpoint may be, in its unit; None: as far as it is. The driver reads the
    servo first and sends a nearer position where it is behind."""
    applied: float | None = field(default=None, compare=False)
    """The position that the driver sent, where `lead` made it nearer than the goal's value."""
    packed: Any = field(default=None, compare=False, repr=False)
    """What `Driver.check_goal` returned for this goal, so that it is not packed twice; None: it was not checked yet."""


@dataclass(frozen=True, slots=True)
class StopTarget:
    """A servo an e-stop must reach."""

    servo: str
    kind: Literal["hold", "limp"]
    enabled: bool  # enabled by us; one that is not is asked whether its torque is on before it is held
    position: float | None = None  # where it is taken to be now: to be written only where it cannot be asked
    setpoint: float | None = None  # the last position that was sent or held; None: not known
    reachable: bool = True  # False: known to be offline; it is written to, and not waited for
    energised: bool = False  # its torque was on when it was last read, whoever switched it on
    leave_alone: bool = False  # an exit: what was not enabled may go on moving, as after its own restart


@dataclass(frozen=True, slots=True)
class StopReport:
    """What an e-stop, a disable or an exit did to one servo.

    Attributes:
        action: hold, limp, park, or none (its torque was off already).
        written: Whether the request was sent.
        confirmed: Whether its effect was read back.
        detail: What a person should know.
    """

    action: str
    written: bool
    confirmed: bool
    detail: str = ""


@dataclass(frozen=True, slots=True)
class Change:
    """What was changed by `set_id` or `set_baudrate`, and whether it is in effect.

    Attributes:
        node: The id at which it was changed.
        what: "id" or "baudrate".
        value: The new id or rate.
        saved: Whether it is kept through a restart.
        pending_reboot: Whether it only takes effect when the servo is saved and restarted.
        notes: What a person should know.
    """

    node: int
    what: Literal["id", "baudrate"]
    value: int
    saved: bool = False
    pending_reboot: bool = True
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        step = "restart the servo" if self.saved else "save and restart the servo"
        return f"pending_reboot: {self.what} {self.value} is set and not in effect yet: {step}"


class Role(IntEnum):
    """What a client of a daemon may do; each role includes the lower ones."""

    NOBODY = 0  # it has not shown a token yet
    OBSERVER = 1  # it reads, and it stops: anyone may stop
    OPERATOR = 2  # it moves servos
    ADMIN = 3  # it changes what is kept: ids, rates, EEPROM, the config

    def __str__(self) -> str:
        return self.name.lower()


def is_loopback(host: str) -> bool:
    """Whether a host is this machine, without asking a name server."""
    from ipaddress import ip_address

    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


def is_number(value: object) -> bool:
    """Whether the value is a finite number, and not a boolean."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer no float can hold
        return False


def no_number(what: str, value: object) -> str:
    """The message about a value that `is_number` refuses."""
    huge = isinstance(value, int) and not isinstance(value, bool)  # Python itself refuses to print it
    return f"{what}: {'a huge integer' if huge else repr(value)[:40]} is not a finite number"


def check_command(commands: Mapping[str, str], name: str) -> str:
    """What the command does. Raises UnknownName, which lists the commands."""
    if name not in commands:
        raise UnknownName(f"no command {name!r}: there are {', '.join(f'{each} ({what})' for each, what in commands.items())}")
    return commands[name]
