"""How a command gets a rig: that of the daemon, else one of its own where no daemon was named or has died.

What a rig of its own needs (`own_rig`) is imported when there is no daemon, so that `servobus stop` reaches a daemon soon.
"""

from __future__ import annotations

import os
import sys
from collections.abc import AsyncIterator, Callable, Collection, Iterator, Mapping
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager
from typing import Any

from servobus.cli.ending import of_command
from servobus.cli.options import BusFacts, Options, RigContext
from servobus.errors import EStopped, InvalidRequest, LinkDown, NotSupported
from servobus.remote.address import NoDaemon
from servobus.remote.rig import RemoteRig, connect
from servobus.rpc.socket_path import VARIABLE, find_socket
from servobus.values import Health, State, StopReport

KEPT = "the daemon keeps it enabled; `servobus disable` disables it"
GONE = "the connection to the daemon is lost: if it has died, nobody stops the servo; `servobus disable --direct` does"
STOPPED = "the e-stop came: `servobus stop` tells what each servo confirmed"
OTHERS = (
    "the daemon at {address} has no bus of {config}: which of the two is meant? Leave the config out (-c, SERVOBUS_CONFIG), or "
    "open its ports in this process (--direct); nothing was sent"
)
TRACE_REFUSED = "a daemon has this bus, and --trace shows only the frames of this process: stop the daemon, or omit --trace"


@asynccontextmanager
async def open_context(
    options: Options,
    names: Collection[str] = (),
    *,
    only: Collection[str] = (),
    degraded: bool = False,
    before: Callable[[Any], object] | None = None,
    energises: bool = False,
) -> AsyncIterator[RigContext]:
    """Connect to the running daemon, else open the ports of the config.

    Args:
        options: The options of the command.
        names: The servos that the command is about; a rig of its own opens their buses alone.
        only: Buses to open in addition; with neither, all are opened.
        degraded: A rig of its own starts without the buses whose ports cannot be opened.
        before: Called with the Config before a port is opened; raises what is to be refused.
        energises: The command moves or energises these servos: when it fails, it says which of them are energised.

    Raises:
        UnknownName: A servo is not in the config; no port was opened.
        DeviceError: A servo did not confirm how it was left.
    """
    async with AsyncExitStack() as stack:
        remote = await _connect(stack, options)
        if remote is not None:
            full = remote.full_names(names)
            with _said_when_it_fails(remote, full if energises else []):
                yield RigContext(remote, lambda: buses_of(remote))
            return
    from servobus.cli.own_rig import open_own

    async with open_own(options, names, only, before, degraded=degraded) as context:
        yield context


@contextmanager
def _said_when_it_fails(rig: RemoteRig, names: Collection[str]) -> Iterator[None]:
    """A command that fails says which of these servos a daemon keeps energised."""

    def energised() -> Mapping[str, State]:
        states = rig.snapshot()
        return {name: states[name] for name in names if name in states and (states[name].enabled or states[name].energised)}

    ending = of_command()
    ending.energised, ending.has_daemon = lambda: dict.fromkeys(energised(), "stays"), True
    try:
        yield
    except BaseException as error:
        stopped = isinstance(error, EStopped)  # what is known of the servos is older than what the e-stop does to them
        for name, state in energised().items():
            confirmed = rig.connected and not stopped and state.health is not Health.OFFLINE
            ending.left[name] = StopReport("stays", False, confirmed, (STOPPED if stopped else KEPT) if rig.connected else GONE)
        raise


async def _connect(stack: AsyncExitStack, options: Options) -> RemoteRig | None:
    """The daemon; None: the command opens ports of its own. Where a config is named, only a daemon that has a bus of that config.

    A daemon that was named and does not answer never becomes ports of this process: they would be those of another rig.
    """
    address = None if options.direct or options.dry_run else options.socket or find_socket()
    if address is None:
        return None
    try:
        rig = await stack.enter_async_context(connect(address, name=f"servobus {' '.join(sys.argv[1:2])} ({os.getpid()})"))
    except LinkDown as error:
        if options.given and not options.socket and isinstance(error, NoDaemon):
            return None  # the socket is left over from a daemon that has died, and the config says whose ports
        others = f"name another one (--socket, {VARIABLE})" if options.socket else "say which ports are meant (-c CONFIG)"
        raise LinkDown(f"{error.message}; or {others}, or open the ports in this process (--direct); nothing was sent") from None
    if options.config is not None:
        from servobus.cli.own_rig import config_of

        served, own = await buses_of(rig), config_of(options).buses
        if not any(name in served and served[name].port == bus.port for name, bus in own.items()):
            await stack.aclose()
            if options.socket:
                raise InvalidRequest(OTHERS.format(address=address, config=options.config))
            return None
    if options.trace:
        raise NotSupported(TRACE_REFUSED)
    return rig


async def buses_of(rig: RemoteRig) -> Mapping[str, BusFacts]:
    buses = (await rig.call("config"))["buses"]
    return {name: BusFacts(bus["protocol"], bus["port"], any((bus["poll"] or {}).values())) for name, bus in buses.items()}
