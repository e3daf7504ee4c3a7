"""The methods of the native door: the verbs of `Rig`, each with its parameters, its result and the least role that may call it.

One line of `METHODS` is all there is to say of a method; a door refuses what does not stand here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import msgspec

from servobus.rig.interface import Found, Reload
from servobus.values import Change, Goal, Identity, Outcome, Role, State, StopReport

PROTOCOL = 1
"""Of these messages: a client of another one is told so at `hello`."""
MAX_LINE = 65_536
"""Bytes of one line, its end included."""
MAX_DEPTH = 32
MAX_BATCH = 100
MAX_SUBSCRIPTIONS = 16
"""Of one connection."""
MIN_HZ, MAX_HZ = 0.1, 200.0


class Params(msgspec.Struct, forbid_unknown_fields=True):
    """By name, or by position in the order here."""


class Nothing(Params):
    """No parameters."""


class Hello(Params):
    """First on TCP, where it must bring the token; on a Unix socket it may, to be known by a name."""

    client: str = ""
    token: str | None = None
    protocol: int = PROTOCOL


class Greeting(msgspec.Struct, frozen=True):
    """What a client is told of the daemon."""

    server: str
    version: str
    protocol: int
    pid: int
    role: str
    lease_ms: int
    names: dict[str, tuple[str, str]]
    """As `Rig.names`."""
    stopped: bool


class Names(Params):
    """Servos by full or unique bare name; none: all."""

    names: tuple[str, ...] = ()


class Name(Params):
    name: str


class Move(Params):
    positions: dict[str, Any]
    together: bool = False
    confirm: bool = False
    speed: Any = None
    duration: Any = None
    start_within: Any = None


class MoveTo(Params):
    name: str
    position: Any
    speed: Any = None
    duration: Any = None
    acceleration: Any = None
    effort: Any = None
    start_within: Any = None
    confirm: bool = False


class Spin(Params):
    name: str
    velocity: Any
    acceleration: Any = None
    effort: Any = None


class SendAll(Params):
    goals: dict[str, Goal]
    together: bool = False
    confirm: bool = False


class Settle(Params):
    names: tuple[str, ...] = ()
    tolerance: float | None = None
    timeout: float = 10.0


class Read(Params):
    name: str
    max_age: float | None = None


class ReadRegister(Params):
    name: str
    register: str
    raw: bool = False


class WriteRegister(Params):
    name: str
    register: str
    value: Any
    raw: bool = False
    persist: bool = False


class Scan(Params):
    bus: str
    baudrates: tuple[int, ...] = ()
    ids: tuple[int, ...] = ()
    progress: bool = False
    """Notices `progress` {bus, asked, count, found} while it lasts."""


class SetId(Params):
    bus: str
    node: int
    new: int
    save: bool = False


class SetBaudrate(Params):
    bus: str
    node: int
    baudrate: int
    save: bool = False


class Command(Params):
    bus: str
    node: int
    name: str
    value: int | None = None


class Subscribe(Params):
    """`state`: snapshots at `hz` of `names`, of `fields` only if some are given; `events`: as they happen; `stats`: at `hz`.

    Notices: `state` {subscription, stopped, missed, states}, `event` {subscription, name, time, fields, missed}, `stats`
    {subscription, missed, stats}."""

    topic: str
    hz: float = 10.0
    names: tuple[str, ...] = ()
    fields: tuple[str, ...] = ()


class Unsubscribe(Params):
    subscription: int


class Lease(msgspec.Struct, frozen=True):
    """What this connection may move, and for how long without a word."""

    names: tuple[str, ...]
    lease_ms: int


class Health(msgspec.Struct, frozen=True):
    """`ok`: every line is up, every servo online, and nothing is stopped."""

    ok: bool
    stopped: bool
    buses: dict[str, bool]
    """Whether the line is up."""
    servos: dict[str, str]
    """online, doubtful or offline."""
    faults: dict[str, tuple[str, ...]]
    """Of those that have any."""


@dataclass(frozen=True, slots=True)
class Method:
    params: type[Params]
    result: Any
    """A type that msgspec can read."""
    role: Role
    motion: bool = False
    """Needs the motion lease of its servos, and takes it if it is free."""


METHODS: dict[str, Method] = {
    "hello": Method(Hello, Greeting, Role.NOBODY),
    "stop": Method(Nothing, dict[str, StopReport], Role.OBSERVER),
    "names": Method(Nothing, dict[str, tuple[str, str]], Role.OBSERVER),
    "read": Method(Read, State, Role.OBSERVER),
    "snapshot": Method(Names, dict[str, State], Role.OBSERVER),
    "stopped": Method(Nothing, bool, Role.OBSERVER),
    "settle": Method(Settle, dict[str, State], Role.OBSERVER),
    "read_register": Method(ReadRegister, Any, Role.OBSERVER),
    "ping": Method(Name, int | None, Role.OBSERVER),
    "identify": Method(Name, Identity, Role.OBSERVER),
    "health": Method(Nothing, Health, Role.OBSERVER),
    "stats": Method(Nothing, dict[str, Any], Role.OBSERVER),
    "config": Method(Nothing, dict[str, Any], Role.OBSERVER),
    "leases": Method(Nothing, dict[str, str], Role.OBSERVER),
    "subscribe": Method(Subscribe, int, Role.OBSERVER),
    "unsubscribe": Method(Unsubscribe, None, Role.OBSERVER),
    "move": Method(Move, dict[str, Outcome], Role.OPERATOR, motion=True),
    "move_to": Method(MoveTo, Outcome, Role.OPERATOR, motion=True),
    "spin": Method(Spin, Outcome, Role.OPERATOR, motion=True),
    "send_all": Method(SendAll, dict[str, Outcome], Role.OPERATOR, motion=True),
    "enable": Method(Names, None, Role.OPERATOR),
    "disable": Method(Names, None, Role.OPERATOR),
    "clear": Method(Nothing, None, Role.OPERATOR),
    "acquire": Method(Names, Lease, Role.OPERATOR),
    "renew": Method(Nothing, Lease, Role.OPERATOR),
    "release": Method(Names, None, Role.OPERATOR),
    "write_register": Method(WriteRegister, Any, Role.OPERATOR),
    "scan": Method(Scan, list[Found], Role.OPERATOR),
    "set_id": Method(SetId, Change, Role.ADMIN),
    "set_baudrate": Method(SetBaudrate, Change, Role.ADMIN),
    "command": Method(Command, tuple[str, ...], Role.ADMIN),
    "reload": Method(Nothing, Reload, Role.ADMIN),
}


def needed_role(method: str, params: Params) -> Role:
    """The least role for this very call: what stays in a servo for good is an admin's."""
    if isinstance(params, WriteRegister) and params.persist:
        return Role.ADMIN
    return METHODS[method].role
