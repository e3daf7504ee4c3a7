"""What each method of the daemon does. The verbs of a rig follow their rows in `rig/verbs.py`; the rest is written here.

A handler returns the result, or a coroutine to await for it: what needs no turn is answered at once.
"""

from __future__ import annotations

import os
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, cast

from servobus import __version__
from servobus.daemon.lease_watch import LeaseWatch
from servobus.daemon.subscriptions import Subscriber, Subscriptions
from servobus.errors import (
    AccessDenied,
    Busy,
    EStopped,
    GoalExpired,
    InvalidRequest,
    LimitError,
    LinkDown,
    NotEnabled,
    NotSupported,
    PartialFailure,
    ServobusError,
)
from servobus.rig.interface import Rig, Servo
from servobus.rig.local import LocalRig
from servobus.rig.verbs import VERBS, LeaseRule, Verb, caller, servos
from servobus.rpc.methods import METHODS, PROTOCOL, Greeting, Hello, LeaseGrant, Names, Nothing, RigHealth, needed_role
from servobus.values import Goal, Health, Outcome, Role, ScanHit

MAX_SCAN = 65_536  # ids and rates of one scan
MAX_SETTLE = 3600.0  # seconds
PROMPT = 0.001  # seconds on its way to the daemon by which a motion is not late


class Client(Subscriber, Protocol):
    """What a handler needs of the connection that calls it."""

    role: Role

    @property
    def label(self) -> str:
        """Its name for others."""

    def greet(self, params: Hello) -> None:
        """Take its name, token and clock. Raises AccessDenied."""

    def age(self, asked: float | None) -> float:
        """Return the seconds since it made a call, at `asked` of its clock; None: the seconds since it may have made it."""

    def has_left(self) -> bool:
        """Return whether it has closed its connection."""

    def cancel(self, call: Any) -> None:
        """Withdraw a call that it made."""

    def notify(self, method: str, params: Any) -> None: ...


@dataclass(frozen=True, slots=True)
class Services:
    """What the connections of one daemon share."""

    rig: LocalRig
    leases: LeaseWatch
    subscriptions: Subscriptions


class LateRig:
    """The rig for a motion that was on its way to the daemon for a while: its goals have that much less time to start."""

    move = Rig.move

    def __init__(self, rig: LocalRig, age: float) -> None:
        self._rig = rig
        self._age = age

    def __getitem__(self, name: str) -> Servo:
        return Servo(cast("Rig", self), self._rig.full_name(name))

    async def send(self, name: str, goal: Goal, *, confirm: bool = False) -> Outcome:
        return await self._rig.send(name, self._rig.shortened(name, goal, self._age), confirm=confirm)

    async def send_all(self, goals: Mapping[str, Goal], *, together: bool = False, confirm: bool = False) -> dict[str, Outcome]:
        shorter = {name: self._rig.shortened(name, goal, self._age) for name, goal in goals.items()}
        return await self._rig.send_all(shorter, together=together, confirm=confirm)


REFUSALS = (Busy, EStopped, GoalExpired, InvalidRequest, LimitError, NotEnabled, NotSupported)
"""Errors of a motion of which nothing was sent."""
Handler = Callable[[Services, Client, Any], Any]


def _verb_handler(verb: Verb) -> Handler:
    """The handler of a verb: the lease rule of its row first, then the call."""
    call = caller(verb)

    def free(services: Services, client: Client, params: Any) -> Any:
        if verb.name != "disable":
            _refuse_absent(client)
        services.leases.check(client, servos(verb, services.rig, params))
        return call(services.rig, params)

    def taken(services: Services, client: Client, params: Any) -> Any:
        rig, age = services.rig, client.age(params.asked)
        names = servos(verb, rig, params)
        if age > PROMPT:
            _refuse_absent(client)
        called = rig if age <= PROMPT else cast("Rig", LateRig(rig, age))
        if rig.stopped:
            return call(called, params)
        fresh = services.leases.take(client, client.label, names)
        return _moved(services.leases, client, fresh, partial(call, called, params)) if fresh else call(called, params)

    rules: dict[LeaseRule, Handler] = {LeaseRule.FREE: free, LeaseRule.TAKEN: taken}
    return rules.get(verb.lease, lambda services, _, params: call(services.rig, params))


async def _moved(leases: LeaseWatch, client: Client, fresh: Mapping[str, int], motion: Callable[[], Awaitable[Any]]) -> Any:
    """Await a motion. One that is refused takes no lease: it has moved nothing."""
    try:
        return await motion()
    except ServobusError as error:
        results = error.results if isinstance(error, PartialFailure) else dict.fromkeys(fresh, error)
        leases.give_back(client, {name: fresh[name] for name in fresh if isinstance(results.get(name), REFUSALS)})
        raise


def _refuse_absent(client: Client) -> None:
    """Refuse a call that was read when its caller had closed the connection already. Raises LinkDown."""
    if client.has_left():
        raise LinkDown("the caller has left: nothing was sent")


# Verbs with something of their own


def read(services: Services, _: Client, params: Any) -> Any:
    rig = services.rig
    state = None if params.max_age is None else rig.recent(params.name, params.max_age)
    return rig.read(params.name, max_age=params.max_age) if state is None else state


def settle(services: Services, _: Client, params: Any) -> Any:
    return services.rig.settle(*params.names, tolerance=params.tolerance, timeout=min(params.timeout, MAX_SETTLE))


def scan(services: Services, client: Client, params: Any) -> Any:
    services.leases.check(client, servos(VERBS["scan"], services.rig, params))
    count = len(params.ids) * max(1, len(params.baudrates))
    if count > MAX_SCAN or not all(0 <= node <= 255 for node in params.ids):
        raise LimitError(f"scan: ids are 0 to 255, and {MAX_SCAN} ids and rates at most: scan fewer")

    def progress(asked: int, total: int, hit: ScanHit | None) -> None:
        client.notify("progress", {"bus": params.bus, "asked": asked, "count": total, "found": hit})

    report = progress if params.progress else None
    return services.rig.scan(params.bus, baudrates=params.baudrates, ids=params.ids, progress=report)


async def reload(services: Services, _: Client, params: Any) -> Any:
    report = await services.rig.reload(force=params.force)
    services.leases.forget_removed()
    return report


def acquire(services: Services, client: Client, params: Names) -> LeaseGrant:
    return _grant(services, services.leases.acquire(client, client.label, services.rig.full_names(params.names)))


def _grant(services: Services, names: set[str]) -> LeaseGrant:
    return LeaseGrant(tuple(sorted(names)), services.leases.lease_ms)


# The daemon itself


def hello(services: Services, client: Client, params: Hello) -> Greeting:
    if params.protocol != PROTOCOL:
        spoken = f"this daemon speaks protocol {PROTOCOL}, you speak {params.protocol}"
        raise NotSupported(f"{spoken}: use a client of version {__version__}")
    client.greet(params)
    rig, role = services.rig, str(client.role)
    return Greeting("servobus", __version__, PROTOCOL, os.getpid(), role, services.leases.lease_ms, dict(rig.names), rig.stopped)


def snapshot(services: Services, _: Client, params: Names) -> Any:
    states = services.rig.snapshot()
    return {name: states[name] for name in services.rig.full_names(params.names)}


def health(services: Services, _: Client, __: Nothing) -> RigHealth:
    rig = services.rig
    states = rig.snapshot()
    buses = {name: bus.master.up for name, bus in rig.buses.items()}
    nodes = {name: state.health.value for name, state in states.items()}
    faults = {name: state.faults for name, state in states.items() if state.faults}
    ok = not rig.stopped and all(buses.values()) and all(each == Health.ONLINE for each in nodes.values())
    return RigHealth(ok, rig.stopped, buses, nodes, faults)


def config(services: Services, _: Client, __: Nothing) -> Any:
    """The buses alone: who has access, and by what token, stays secret."""
    setup = services.rig.config
    buses = {name: setup.buses[name].model_dump(mode="json") for name in services.rig.buses}
    return {"version": setup.version, "buses": buses}


HANDLERS: dict[str, Handler] = {
    **{verb.name: _verb_handler(verb) for verb in VERBS.values() if verb.door},
    "read": read,
    "settle": settle,
    "scan": scan,
    "reload": reload,
    "acquire": acquire,
    "renew": lambda services, client, _: _grant(services, services.leases.renew(client)),
    "release": lambda services, client, params: services.leases.release(client, services.rig.full_names(params.names)),
    "hello": hello,
    "names": lambda services, _, __: dict(services.rig.names),
    "snapshot": snapshot,
    "stopped": lambda services, _, __: services.rig.stopped,
    "health": health,
    "stats": lambda services, _, __: services.rig.stats(),
    "config": config,
    "leases": lambda services, _, __: services.leases.holders(),
    "subscribe": lambda services, client, params: services.subscriptions.add(client, params),
    "cancel": lambda _, client, params: client.cancel(params.call),
    "unsubscribe": lambda services, client, params: services.subscriptions.remove(client, params.subscription),
}


def require_role(client: Client, method: str, params: Any) -> None:
    """Refuse a call that the client's role does not allow. Raises AccessDenied."""
    needed = needed_role(method, params)
    if client.role >= needed:
        return
    if client.role is METHODS["hello"].role:
        raise AccessDenied("say hello first, with the token")
    problem = f"{method} is for the role {needed}, you are {client.role}"
    raise AccessDenied(f"{problem}: ask who runs the daemon (access: in its config)")
