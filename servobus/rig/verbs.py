"""The table of verbs: what is mechanical about a verb of `Rig` is derived from its signature and from one row here.

To add a verb, write its signature and docstring in `interface.py`, its work in `local.py`, and its row in `VERBS`. The daemon's
messages (`rpc/methods.py`), its handlers and roles (`daemon/methods.py`), the remote rig and the blocking rig follow from these;
`scripts/stubs` writes down the types of the blocking rig for type checkers.
"""

from __future__ import annotations

import collections.abc
import functools
import inspect
from collections.abc import Callable, Coroutine, Mapping
from dataclasses import dataclass
from enum import Enum
from types import GenericAlias, NoneType, UnionType
from typing import Any, get_args, get_origin

from servobus.rig.interface import Rig, Servo
from servobus.values import Role

DEADLINE = 10.0  # seconds that a client waits for the reply of a verb
SLOW = 30.0  # the same for a verb that goes through a whole bus


class LeaseRule(Enum):
    """What a verb demands of the motion leases of its servos."""

    NONE = "none"  # nothing
    FREE = "free"  # no other client may hold one
    TAKEN = "taken"  # the client takes them, unless another one holds one


@dataclass(frozen=True, slots=True)
class Verb:
    """One row: a method of `Rig`, or one of `Servo` that takes the servo's name first where there is no `Servo`."""

    function: Callable[..., Coroutine[Any, Any, Any]]
    role: Role  # the least role that may call it through a daemon
    lease: LeaseRule = LeaseRule.NONE
    deadline: float = DEADLINE
    refreshes: bool = False  # it changes what `snapshot` shows: a remote rig reads that again before the verb returns
    door: bool = True  # it is a method of the daemon; False: a client makes it of another verb

    @property
    def name(self) -> str:
        return self.function.__name__

    @property
    def of_servo(self) -> bool:
        return getattr(Servo, self.name, None) is self.function


OBSERVER, OPERATOR, ADMIN = Role.OBSERVER, Role.OPERATOR, Role.ADMIN
FREE, TAKEN = LeaseRule.FREE, LeaseRule.TAKEN
ROWS = (
    Verb(Rig.stop, OBSERVER, refreshes=True),
    Verb(Rig.read, OBSERVER),
    Verb(Rig.settle, OBSERVER),
    Verb(Rig.read_register, OBSERVER),
    Verb(Rig.ping, OBSERVER),
    Verb(Rig.identify, OBSERVER),
    Verb(Rig.move, OPERATOR, TAKEN),
    Verb(Servo.move_to, OPERATOR, TAKEN),
    Verb(Servo.spin, OPERATOR, TAKEN),
    Verb(Rig.send, OPERATOR, TAKEN, door=False),
    Verb(Rig.send_all, OPERATOR, TAKEN),
    Verb(Rig.enable, OPERATOR, FREE, refreshes=True),
    Verb(Rig.disable, OPERATOR, FREE, refreshes=True),
    Verb(Rig.clear, OPERATOR, refreshes=True),
    Verb(Rig.acquire, OPERATOR),
    Verb(Rig.release, OPERATOR),
    Verb(Rig.write_register, OPERATOR, FREE),
    Verb(Rig.scan, OPERATOR, FREE, SLOW),
    Verb(Rig.set_id, ADMIN, FREE, SLOW),
    Verb(Rig.set_baudrate, ADMIN, FREE, SLOW),
    Verb(Rig.command, ADMIN, FREE),
    Verb(Rig.reload, ADMIN, deadline=60.0, refreshes=True),
)
VERBS: dict[str, Verb] = {verb.name: verb for verb in ROWS}


@functools.cache
def signature(verb: Verb) -> inspect.Signature:
    """The verb's signature without `self`; that of a servo's verb begins with the servo's name."""
    whole = inspect.signature(verb.function, eval_str=True)
    own = list(whole.parameters.values())[1:]
    name = inspect.Parameter("name", inspect.Parameter.POSITIONAL_OR_KEYWORD, annotation=str)
    return whole.replace(parameters=[name, *own] if verb.of_servo else own)


def fields(verb: Verb) -> list[tuple[str, Any] | tuple[str, Any, Any]]:
    """The parameters as fields of a message: name, type, and default where there is one."""
    columns: list[tuple[str, Any] | tuple[str, Any, Any]] = []
    for parameter in signature(verb).parameters.values():
        if parameter.kind is parameter.VAR_POSITIONAL:
            columns.append((parameter.name, GenericAlias(tuple, (parameter.annotation, ...)), ()))
            continue
        kind, default = _message_type(parameter.annotation, goal=verb.lease is TAKEN), parameter.default
        if kind is bool and default is None:  # a callback: whether its calls are wanted
            default = False
        columns.append((parameter.name, kind) if default is parameter.empty else (parameter.name, kind, default))
    return columns


def _message_type(kind: Any, *, goal: bool) -> Any:
    """The numbers of a goal are checked by the rig, whose refusal names the servo: any value passes here."""
    origin, args = get_origin(kind), get_args(kind)
    if origin is collections.abc.Iterable:
        return GenericAlias(tuple, (args[0], ...))
    if origin is collections.abc.Mapping:
        return GenericAlias(dict, (args[0], _message_type(args[1], goal=goal)))
    if origin is collections.abc.Callable:
        return bool
    if isinstance(kind, UnionType):
        others = [part for part in args if part is not NoneType]
        if len(others) == 1 and (simple := _message_type(others[0], goal=goal)) in (bool, Any):
            return simple
    return Any if goal and kind is float else kind


def arguments(verb: Verb, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a message for a call of the verb. Raises TypeError where the call does not fit the signature."""
    bound = signature(verb).bind(*args, **kwargs)
    bound.apply_defaults()
    return bound.arguments


def caller(verb: Verb) -> Callable[[Rig, Any], Coroutine[Any, Any, Any]]:
    """A function that calls the verb on a rig with the attributes of a message as arguments."""
    parameters = list(signature(verb).parameters.values())[verb.of_servo :]
    plain = [each.name for each in parameters if each.kind is each.POSITIONAL_OR_KEYWORD]
    several = [each.name for each in parameters if each.kind is each.VAR_POSITIONAL]
    keywords = [each.name for each in parameters if each.kind is each.KEYWORD_ONLY]

    def call(rig: Rig, params: Any) -> Coroutine[Any, Any, Any]:
        target = rig[params.name] if verb.of_servo else rig
        args = [getattr(params, name) for name in plain]
        for name in several:
            args += getattr(params, name)
        method: Callable[..., Coroutine[Any, Any, Any]] = getattr(target, verb.name)
        return method(*args, **{name: getattr(params, name) for name in keywords})

    return call


def servos(verb: Verb, rig: Rig, params: Any) -> list[str]:
    """Full names of the servos that a message is about: those it names, those of its bus, or all. Raises UnknownName."""
    first = next(iter(signature(verb).parameters), "")
    if first == "bus":
        return [name for name, (bus, _) in rig.names.items() if bus == params.bus]
    if first == "name":
        return [rig.full_name(params.name)]
    named = getattr(params, first) if first else ()
    return rig.full_names(named) if first == "names" else [rig.full_name(name) for name in named]
