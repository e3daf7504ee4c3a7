"""What each method does with the rig. What needs no turn is answered at once; everything else is awaited in a task of its own."""

from __future__ import annotations

import os
from collections.abc import Awaitable, Callable, Iterable
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from servobus.errors import AccessDenied, LimitError, NotSupported
from servobus.rig.interface import Found
from servobus.rpc import methods as rpc
from servobus.rpc.methods import METHODS, PROTOCOL, Greeting, Health, Lease
from servobus.values import Goal

if TYPE_CHECKING:
    from servobus.daemon.connection import Connection

LATER = Awaitable[Any]
Verb = Callable[["Connection", Any], Any]
"""Returns the result, or something to await for it."""


def hello(client: Connection, params: rpc.Hello) -> Greeting:
    if params.protocol != PROTOCOL:
        raise NotSupported(
            f"this daemon speaks protocol {PROTOCOL}, you speak {params.protocol}: use a client of version {VERSION}"
        )
    client.greet(params)
    rig = client.door.rig
    ttl = round(1e3 * client.door.leasing.leases.ttl)
    return Greeting("servobus", VERSION, PROTOCOL, os.getpid(), str(client.role), ttl, dict(rig.names), rig.stopped)


def read(client: Connection, params: rpc.Read) -> Any:
    rig = client.door.rig
    known = None if params.max_age is None else rig.known(params.name, params.max_age)
    return rig.read(params.name, max_age=params.max_age) if known is None else known


def snapshot(client: Connection, params: rpc.Names) -> Any:
    rig = client.door.rig
    states = rig.snapshot()
    return {name: states[name] for name in rig.full_names(params.names)}


def health(client: Connection, _: rpc.Nothing) -> Health:
    rig = client.door.rig
    states = rig.snapshot()
    buses = {name: bus.master.up for name, bus in rig.buses.items()}
    servos = {name: state.health.value for name, state in states.items()}
    faults = {name: state.faults for name, state in states.items() if state.faults}
    ok = not rig.stopped and all(buses.values()) and all(each == "online" for each in servos.values())
    return Health(ok, rig.stopped, buses, servos, faults)


def config(client: Connection, _: rpc.Nothing) -> Any:
    """Of the buses alone: who may come in, and by what token, is nobody's business."""
    setup = client.door.rig.config
    buses = {name: setup.buses[name].model_dump(mode="json") for name in client.door.rig.buses}
    return {"version": setup.version, "buses": buses}


# Motion


def _moved(client: Connection, names: Iterable[str]) -> None:
    """Raises UnknownName, LeaseHeld. What cannot move (the e-stop is latched) takes no lease either."""
    full = [client.door.rig.full_name(name) for name in names]
    if not client.door.rig.stopped:
        client.door.leasing.take(client, client.label, full)


def _free(client: Connection, names: Iterable[str]) -> None:
    client.door.leasing.check(client, client.door.rig.full_names(names))


def _bus_free(client: Connection, bus: str) -> None:
    client.door.leasing.check(client, [name for name, place in client.door.rig.names.items() if place[0] == bus])


def move(client: Connection, params: rpc.Move) -> LATER:
    _moved(client, params.positions)
    keys = {key: getattr(params, key) for key in ("together", "confirm", "speed", "duration", "start_within")}
    return client.door.rig.move(params.positions, **keys)


def move_to(client: Connection, params: rpc.MoveTo) -> LATER:
    _moved(client, [params.name])
    keys = {key: getattr(params, key) for key in ("speed", "duration", "acceleration", "effort", "start_within", "confirm")}
    return client.door.rig[params.name].move_to(params.position, **keys)


def spin(client: Connection, params: rpc.Spin) -> LATER:
    _moved(client, [params.name])
    return client.door.rig[params.name].spin(params.velocity, acceleration=params.acceleration, effort=params.effort)


def send_all(client: Connection, params: rpc.SendAll) -> LATER:
    _moved(client, params.goals)
    goals: dict[str, Goal] = params.goals
    return client.door.rig.send_all(goals, together=params.together, confirm=params.confirm)


def enable(client: Connection, params: rpc.Names) -> LATER:
    _free(client, params.names)
    return client.door.rig.enable(*params.names)


def disable(client: Connection, params: rpc.Names) -> LATER:
    _free(client, params.names)
    return client.door.rig.disable(*params.names)


def write_register(client: Connection, params: rpc.WriteRegister) -> LATER:
    _free(client, [params.name])
    rig = client.door.rig
    return rig.write_register(params.name, params.register, params.value, raw=params.raw, persist=params.persist)


def set_id(client: Connection, params: rpc.SetId) -> LATER:
    _bus_free(client, params.bus)
    return client.door.rig.set_id(params.bus, params.node, params.new, save=params.save)


def set_baudrate(client: Connection, params: rpc.SetBaudrate) -> LATER:
    _bus_free(client, params.bus)
    return client.door.rig.set_baudrate(params.bus, params.node, params.baudrate, save=params.save)


def command(client: Connection, params: rpc.Command) -> LATER:
    _bus_free(client, params.bus)
    return client.door.rig.command(params.bus, params.node, params.name, params.value)


def scan(client: Connection, params: rpc.Scan) -> LATER:
    _bus_free(client, params.bus)
    count = len(params.ids) * max(1, len(params.baudrates))
    if count > 65_536 or not all(0 <= node <= 255 for node in params.ids):
        raise LimitError("ids are 0 to 255, and there is an end to their number: scan fewer")

    def progress(asked: int, total: int, hit: Found | None) -> None:
        client.notify("progress", {"bus": params.bus, "asked": asked, "count": total, "found": hit})

    told = progress if params.progress else None
    return client.door.rig.scan(params.bus, baudrates=params.baudrates, ids=params.ids, progress=told)


# Leases


def acquire(client: Connection, params: rpc.Names) -> Lease:
    held = client.door.leasing.acquire(client, client.label, client.door.rig.full_names(params.names))
    return _lease(client, held)


def renew(client: Connection, _: rpc.Nothing) -> Lease:
    return _lease(client, client.door.leasing.renew(client))


def release(client: Connection, params: rpc.Names) -> None:
    client.door.leasing.release(client, client.door.rig.full_names(params.names))


def _lease(client: Connection, held: set[str]) -> Lease:
    return Lease(tuple(sorted(held)), round(1e3 * client.door.leasing.leases.ttl))


# The door itself


async def reload(client: Connection, _: rpc.Nothing) -> Any:
    report = await client.door.rig.reload()
    client.door.leasing.reloaded()
    return report


def subscribe(client: Connection, params: rpc.Subscribe) -> int:
    return client.door.subscriptions.add(client, params)


def unsubscribe(client: Connection, params: rpc.Unsubscribe) -> None:
    client.door.subscriptions.remove(client, params.subscription)


VERBS: dict[str, Verb] = {
    "hello": hello,
    "stop": lambda client, _: client.door.rig.stop(),
    "names": lambda client, _: dict(client.door.rig.names),
    "read": read,
    "snapshot": snapshot,
    "stopped": lambda client, _: client.door.rig.stopped,
    "settle": lambda client, params: client.door.rig.settle(
        *params.names, tolerance=params.tolerance, timeout=min(params.timeout, 3600.0)
    ),
    "read_register": lambda client, params: client.door.rig.read_register(params.name, params.register, raw=params.raw),
    "ping": lambda client, params: client.door.rig.ping(params.name),
    "identify": lambda client, params: client.door.rig.identify(params.name),
    "health": health,
    "stats": lambda client, _: client.door.rig.stats(),
    "config": config,
    "leases": lambda client, _: client.door.leasing.leases.holders(),
    "subscribe": subscribe,
    "unsubscribe": unsubscribe,
    "move": move,
    "move_to": move_to,
    "spin": spin,
    "send_all": send_all,
    "enable": enable,
    "disable": disable,
    "clear": lambda client, _: client.door.rig.clear(),
    "acquire": acquire,
    "renew": renew,
    "release": release,
    "write_register": write_register,
    "scan": scan,
    "set_id": set_id,
    "set_baudrate": set_baudrate,
    "command": command,
    "reload": reload,
}
VERSION = version("servobus")


def require(client: Connection, method: str, params: Any) -> None:
    """Deny by default. Raises AccessDenied."""
    needed = rpc.needed_role(method, params)
    if client.role < needed:
        if client.role is METHODS["hello"].role:
            raise AccessDenied("say hello first, with the token")
        raise AccessDenied(
            f"{method} is for the role {needed}, you are {client.role}: ask who runs the daemon (access: in its config)"
        )
