"""How a command comes by a rig: from the daemon that runs, else with ports of its own."""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import AsyncIterator, Callable, Collection
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import click

from servobus.cli.frames import Tracer
from servobus.cli.safe_stream import SafeStream
from servobus.config.loader import Config, load_config
from servobus.errors import ConfigError, DeviceError, LinkDown, NotSupported, PortBusy
from servobus.protocols.registry import PROTOCOLS
from servobus.remote.rig import RemoteRig, connect
from servobus.rig.interface import Rig, full_name
from servobus.rig.local import open_rig
from servobus.rig.supervisor import Trace
from servobus.rpc.socket_path import find_socket

F = TypeVar("F", bound=Callable[..., Any])
DEFAULT_CONFIG = "servobus.yaml"
DIRECT = "a daemon has this bus, and --trace shows only what this process says: stop the daemon, or leave --trace out"


@dataclass(frozen=True)
class Options:
    """What every command on servos takes."""

    config: str | None
    as_json: bool
    trace: bool
    dry_run: bool
    direct: bool = False
    bare: Config | None = None
    """Instead of a file: of one port."""

    @cached_property
    def setup(self) -> Config:
        """The config; on simulated servos when nothing shall be sent. Raises ConfigError."""
        config = self._load() if self.bare is None else self.bare
        return simulated(config) if self.dry_run else config

    def _load(self) -> Config:
        if self.config is None and not Path(DEFAULT_CONFIG).exists():
            raise ConfigError(
                "no daemon runs, and there is no config: give -c CONFIG, set SERVOBUS_CONFIG, or make "
                f"./{DEFAULT_CONFIG} (`servobus scan --yaml` writes one)"
            )
        return load_config(self.config or DEFAULT_CONFIG)


def servo_options(command: F) -> F:
    """Adds the options and hands them over as one `options`."""

    @click.option(
        "-c", "--config", envvar="SERVOBUS_CONFIG", metavar="CONFIG", help="Bus config (YAML). Default: ./servobus.yaml."
    )
    @click.option("--json", "as_json", is_flag=True, help="For machines: one JSON document on standard output.")
    @click.option("--trace", is_flag=True, help="Print every frame, both ways and decoded, on standard error.")
    @click.option("--dry-run", is_flag=True, help="Open no port: run on simulated servos and print what would be sent.")
    @click.option("--direct", is_flag=True, help="Open the ports here even if a daemon runs.")
    @functools.wraps(command)
    def wrapper(config: str | None, as_json: bool, trace: bool, dry_run: bool, direct: bool, **arguments: Any) -> Any:
        return command(options=Options(config, as_json, trace, dry_run, direct), **arguments)

    return wrapper  # type: ignore[return-value]


def simulated(config: Config) -> Config:
    """The same servos, but none of them real."""
    buses = {name: options.model_copy(update={"port": "sim:", "faults": None}) for name, options in config.buses.items()}
    return replace(config, buses=buses)


@asynccontextmanager
async def opened(
    options: Options,
    names: Collection[str] = (),
    *,
    only: Collection[str] = (),
    degraded: bool = False,
    before: Callable[[Config], object] | None = None,
) -> AsyncIterator[Rig]:
    """The running daemon's rig; else one of its own with the buses of these servos, or with `only` these, or with all.

    For a rig of its own: `degraded`: without those whose port cannot be opened; `before`: what is to be refused before one is
    opened. Raises UnknownName before a port is opened, and DeviceError when a servo did not confirm how it was left."""
    async with AsyncExitStack() as stack:
        remote = await _daemon(stack, options)
        if remote is not None:
            remote.full_names(names)
            yield remote
            return
    config = options.setup
    full = [full_name(config.names, name) for name in names]
    if before is not None:
        before(config)
    buses = dict.fromkeys([*only, *(config.names[name][0] for name in full)])
    try:
        async with traced(config, options) as trace, open_rig(config, buses=list(buses), degraded=degraded, trace=trace) as rig:
            yield rig
    except PortBusy as error:
        raise await _hinted(error) from None
    doubtful = [f"{name} ({report.action}: {report.detail})" for name, report in rig.left.items() if not report.confirmed]
    if doubtful:
        raise DeviceError(f"not confirmed how it was left: {', '.join(doubtful)}; look before you touch")


async def _daemon(stack: AsyncExitStack, options: Options) -> RemoteRig | None:
    """The daemon that serves what the command is about: any, where no config is named; else one with a bus of that config."""
    path = None if options.direct or options.dry_run else find_socket()
    if path is None:
        return None
    try:
        rig = await stack.enter_async_context(connect(path, name=f"servobus {' '.join(sys.argv[1:2])} ({os.getpid()})"))
    except LinkDown:
        return None  # nobody listens there any more
    if options.config is not None:
        theirs = (await rig.call("config"))["buses"]
        if not any(name in theirs and theirs[name]["port"] == bus.port for name, bus in options.setup.buses.items()):
            await stack.aclose()
            return None
    if options.trace:
        raise NotSupported(DIRECT)
    return rig


async def _hinted(error: PortBusy) -> PortBusy:
    """The same, with the next step where the daemon is the holder."""
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
    """What prints frames in words, if that is wanted. A dry run prints what would be sent, on standard output unless that is
    JSON."""
    if options.dry_run:
        click.echo("dry run: on simulated servos, no port is opened", err=True)
    if not (options.trace or options.dry_run):
        yield None
        return
    codecs = {name: PROTOCOLS[bus.protocol].codec(bus) for name, bus in config.buses.items()}
    voice = SafeStream(sys.stderr if options.trace or options.as_json else sys.stdout)
    tracer = Tracer(codecs, voice.say, heard=options.trace)
    try:
        yield tracer
    finally:
        tracer.close()
