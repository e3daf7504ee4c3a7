"""How a command gets a rig: that of the running daemon, else one with ports of its own."""

from __future__ import annotations

import os
import sys
from collections.abc import AsyncIterator, Callable, Collection, Mapping
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import replace
from pathlib import Path

from servobus.cli.frames import Tracer
from servobus.cli.options import BusFacts, Options, RigContext
from servobus.cli.output import echo
from servobus.cli.safe_stream import SafeStream
from servobus.config.loader import Config, load_config
from servobus.errors import ConfigError, DeviceError, LinkDown, NotSupported, PortBusy
from servobus.protocols.registry import PROTOCOLS
from servobus.remote.rig import RemoteRig, connect
from servobus.rig.interface import full_name
from servobus.rig.local import open_rig
from servobus.rig.supervisor import Trace
from servobus.rpc.socket_path import find_socket

DEFAULT_CONFIG = "servobus.yaml"
TRACE_REFUSED = "a daemon has this bus, and --trace shows only the frames of this process: stop the daemon, or omit --trace"


def config_of(options: Options) -> Config:
    """The config of a command; with --dry-run all its servos are simulated. Raises ConfigError."""
    config = _load(options.config) if options.parsed is None else options.parsed
    return simulated(config) if options.dry_run else config


def _load(path: str | None) -> Config:
    if path is None and not Path(DEFAULT_CONFIG).exists():
        raise ConfigError(
            "no daemon runs, and there is no config: give -c CONFIG, set SERVOBUS_CONFIG, or make "
            f"./{DEFAULT_CONFIG} (`servobus scan --yaml` writes one)"
        )
    return load_config(path or DEFAULT_CONFIG)


def simulated(config: Config) -> Config:
    """The same config with every bus on a simulated line."""
    buses = {name: options.model_copy(update={"port": "sim:", "faults": None}) for name, options in config.buses.items()}
    return replace(config, buses=buses)


@asynccontextmanager
async def open_context(
    options: Options,
    names: Collection[str] = (),
    *,
    only: Collection[str] = (),
    degraded: bool = False,
    before: Callable[[Config], object] | None = None,
) -> AsyncIterator[RigContext]:
    """Connect to the running daemon, else open the ports of the config.

    Args:
        options: The options of the command.
        names: The servos that the command is about; a rig of its own opens their buses alone.
        only: Buses to open in addition; with neither, all are opened.
        degraded: A rig of its own starts without the buses whose ports cannot be opened.
        before: Called with the config before a port is opened; raises what is to be refused.

    Raises:
        UnknownName: A servo is not in the config; no port was opened.
        DeviceError: A servo did not confirm how it was left.
    """
    async with AsyncExitStack() as stack:
        remote = await _connect(stack, options)
        if remote is not None:
            remote.full_names(names)
            yield RigContext(remote, lambda: _buses_of_daemon(remote))
            return
    config = config_of(options)
    full = [full_name(config.names, name) for name in names]
    if before is not None:
        before(config)
    buses = dict.fromkeys([*only, *(config.names[name][0] for name in full)])
    try:
        async with (
            traced(config, options) as trace,
            open_rig(config, buses=list(buses), degraded=degraded, trace=trace) as rig,
        ):
            yield RigContext(rig, lambda: _buses_of_config(config), _on_exit(config))
    except PortBusy as error:
        raise await _with_hint(error) from None
    doubtful = [f"{name} ({report.action}: {report.detail})" for name, report in rig.left.items() if not report.confirmed]
    if doubtful:
        raise DeviceError(f"not confirmed how it was left: {', '.join(doubtful)}; look before you touch")


async def _connect(stack: AsyncExitStack, options: Options) -> RemoteRig | None:
    """The running daemon. Where a config is named, only a daemon that has a bus of that config."""
    path = None if options.direct or options.dry_run else find_socket()
    if path is None:
        return None
    try:
        rig = await stack.enter_async_context(connect(path, name=f"servobus {' '.join(sys.argv[1:2])} ({os.getpid()})"))
    except LinkDown:
        return None  # the socket is left over from a daemon that ended
    if options.config is not None:
        served = await _buses_of_daemon(rig)
        if not any(name in served and served[name].port == bus.port for name, bus in config_of(options).buses.items()):
            await stack.aclose()
            return None
    if options.trace:
        raise NotSupported(TRACE_REFUSED)
    return rig


async def _buses_of_daemon(rig: RemoteRig) -> Mapping[str, BusFacts]:
    buses = (await rig.call("config"))["buses"]
    return {name: BusFacts(bus["protocol"], bus["port"], any((bus["poll"] or {}).values())) for name, bus in buses.items()}


async def _buses_of_config(config: Config) -> Mapping[str, BusFacts]:
    return {name: BusFacts(bus.protocol, bus.port, bool(bus.poll.rates())) for name, bus in config.buses.items()}


def _on_exit(config: Config) -> Mapping[str, str]:
    return {name: config.buses[bus].servos[servo].on_exit for name, (bus, servo) in config.names.items()}


async def _with_hint(error: PortBusy) -> PortBusy:
    """The same error, with the next step where the daemon holds the port."""
    path = find_socket()
    if path is None:
        return error
    try:
        async with connect(path) as rig:
            pid = (await rig.call("hello")).pid
    except LinkDown:
        return error
    hint = f"{error.message}; the servobus daemon (pid {pid}) owns it: leave --direct out, or stop the daemon"
    return PortBusy(hint, bus=error.bus)


@asynccontextmanager
async def traced(config: Config, options: Options) -> AsyncIterator[Trace | None]:
    """Makes the printer of frames for --trace and --dry-run.

    A dry run prints the requests alone, on standard output unless that is JSON.
    """
    if options.dry_run:
        echo("dry run: on simulated servos, no port is opened", err=True)
    if not (options.trace or options.dry_run):
        yield None
        return
    codecs = {name: PROTOCOLS[bus.protocol].codec(bus) for name, bus in config.buses.items()}
    stream = SafeStream(sys.stderr if options.trace or options.as_json else sys.stdout)
    tracer = Tracer(codecs, stream.write_line, replies=options.trace)
    try:
        yield tracer
    finally:
        tracer.close()
