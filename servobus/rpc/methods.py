"""The methods of the daemon: each with its parameters, its result and the least role that may call it.

The verbs of a rig come from `rig/verbs.py`; only what a daemon has besides is written out here. Any other method is refused.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import msgspec

from servobus.rig.verbs import DEADLINE, VERBS, LeaseRule, Verb, fields, signature
from servobus.values import Role, State

PROTOCOL = 1  # version of these messages. A client of another version is refused at `hello`.
MAX_LINE = 65_536  # bytes of one line, its end included
MAX_DEPTH = 32  # levels of one line
MAX_BATCH = 100  # calls in one array
MAX_SUBSCRIPTIONS = 16  # subscriptions of one connection
MIN_HZ, MAX_HZ = 0.1, 200.0


class Params(msgspec.Struct, forbid_unknown_fields=True):
    """Parameters of a method, given by name or by position in this order."""


class Nothing(Params):
    """No parameters."""


class Hello(Params):
    """The first call on TCP, with the token. On a Unix socket it is optional, and gives the client a name.

    `machine` and `asked` tell whose clock the client has (`rpc/clock.py`).
    """

    client: str = ""
    token: str | None = None
    protocol: int = PROTOCOL
    machine: str = ""
    asked: float | None = None


class Cancel(Params):
    """The id of an earlier call of this connection that its caller does not want any more."""

    call: int | str | float


class Greeting(msgspec.Struct, frozen=True):
    """What a daemon says of itself. `names` as `Rig.names`; `lease_ms`: how long a lease lasts without a renewal."""

    server: str
    version: str
    protocol: int
    pid: int
    role: str
    lease_ms: int
    names: dict[str, tuple[str, str]]
    stopped: bool


class Names(Params):
    """Servos by full or unique bare name; none: all."""

    names: tuple[str, ...] = ()


class Subscribe(Params):
    """What to notify of.

    `state`: snapshots at `hz` of `names`, of `fields` only if some are given; `stats`: at `hz`; `events`: as they happen.
    Notices: `state` {subscription, stopped, missed, states}, `event` {subscription, name, time, fields, missed}, `stats`
    {subscription, missed, stats}.
    """

    topic: str
    hz: float = 10.0
    names: tuple[str, ...] = ()
    fields: tuple[str, ...] = ()


class Unsubscribe(Params):
    """The number that `subscribe` returned."""

    subscription: int


class LeaseGrant(msgspec.Struct, frozen=True):
    """What this connection may move, and for how many milliseconds without a renewal."""

    names: tuple[str, ...]
    lease_ms: int


class RigHealth(msgspec.Struct, frozen=True):
    """`ok`: every line is up, every servo is online, and the e-stop is not latched."""

    ok: bool
    stopped: bool
    buses: dict[str, bool]  # whether the line is up
    servos: dict[str, str]  # online, doubtful or offline
    faults: dict[str, tuple[str, ...]]  # of the servos that have any


@dataclass(frozen=True, slots=True)
class Method:
    """One row of the method table. `result` is a type that msgspec can read."""

    params: type[Params]
    result: Any
    role: Role
    motion: bool = False  # it takes the motion leases of its servos
    deadline: float = DEADLINE  # seconds a client waits for the reply; `scan` from one `progress` notice to the next


def method_of(verb: Verb) -> Method:
    """A verb as a method: a message with the fields of its signature; for a motion also `asked`, when its caller called."""
    title = "".join(part.capitalize() for part in verb.name.split("_"))
    doc = {"__doc__": verb.function.__doc__}
    motion = verb.lease is LeaseRule.TAKEN
    columns = [*fields(verb), ("asked", float | None, None)] if motion else fields(verb)
    made = msgspec.defstruct(title, columns, bases=(Params,), namespace=doc, forbid_unknown_fields=True, module=__name__)
    params = cast("type[Params]", made)
    return Method(params, signature(verb).return_annotation, verb.role, motion, verb.deadline)


METHODS: dict[str, Method] = {
    "hello": Method(Hello, Greeting, Role.NOBODY),
    "names": Method(Nothing, dict[str, tuple[str, str]], Role.OBSERVER),
    "snapshot": Method(Names, dict[str, State], Role.OBSERVER),
    "stopped": Method(Nothing, bool, Role.OBSERVER),
    "health": Method(Nothing, RigHealth, Role.OBSERVER),
    "stats": Method(Nothing, dict[str, Any], Role.OBSERVER),
    "config": Method(Nothing, dict[str, Any], Role.OBSERVER),
    "leases": Method(Nothing, dict[str, str], Role.OBSERVER),
    "subscribe": Method(Subscribe, int, Role.OBSERVER),
    "unsubscribe": Method(Unsubscribe, None, Role.OBSERVER),
    "cancel": Method(Cancel, None, Role.OBSERVER),
    **{verb.name: method_of(verb) for verb in VERBS.values() if verb.door},
    "acquire": Method(Names, LeaseGrant, Role.OPERATOR),
    "renew": Method(Nothing, LeaseGrant, Role.OPERATOR),
}


def needed_role(method: str, params: Params) -> Role:
    """The least role for this call: what stays in a servo for good is an admin's."""
    return Role.ADMIN if getattr(params, "persist", False) else METHODS[method].role
