"""The rig of a command without a daemon: the buses of a config, opened in this process."""

from __future__ import annotations

import sys
from collections.abc import AsyncIterator, Callable, Collection, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager
from dataclasses import replace
from pathlib import Path

from servobus.cli.ending import of_command
from servobus.cli.frames import Tracer
from servobus.cli.logs import SafeStream
from servobus.cli.options import BusFacts, Options, RigContext
from servobus.cli.output import echo
from servobus.config.loader import Config, load_config
from servobus.errors import ConfigError, DeviceError, PortBusy, ServobusError
from servobus.protocols.registry import PROTOCOLS
from servobus.remote.rig import connect
from servobus.rig.interface import full_name
from servobus.rig.local import open_rig
from servobus.rig.supervisor import Trace
from servobus.rpc.socket_path import find_socket

DEFAULT_CONFIG = "servobus.yaml"


def config_of(options: Options) -> Config:
    """The config of a command; with --dry-run every bus is on a simulated line. Raises ConfigError."""
    config: Config = _load(options.config) if options.parsed is None else options.parsed
    if not options.dry_run:
        return config
    simulated = {name: bus.model_copy(update={"port": "sim:", "faults": None}) for name, bus in config.buses.items()}
    return replace(config, buses=simulated)


def _load(path: str | None) -> Config:
    if path is None and not Path(DEFAULT_CONFIG).exists():
        make = f"make ./{DEFAULT_CONFIG} (`servobus scan --yaml` writes one)"
        raise ConfigError(f"no daemon runs, and there is no config: give -c CONFIG, set SERVOBUS_CONFIG, or {make}")
    return load_config(path or DEFAULT_CONFIG)


@asynccontextmanager
async def open_own(
    options: Options, names: Collection[str], only: Collection[str], before: Callable[[Config], object] | None, *, degraded: bool
) -> AsyncIterator[RigContext]:
    """Open the ports; the arguments are those of `rig_context.open_context`."""
    config = config_of(options)
    full = [full_name(config.names, name) for name in names]
    if before is not None:
        before(config)
    buses = dict.fromkeys([*only, *(config.names[name][0] for name in full)])
    ending = of_command()
    try:
        with _traced(config, options) as trace:
            async with open_rig(config, buses=list(buses), degraded=degraded, trace=trace) as rig:
                if not options.dry_run:
                    ending.energised = rig.to_leave
                on_exit = {name: config.buses[bus].servos[servo].on_exit for name, (bus, servo) in config.names.items()}
                yield RigContext(rig, lambda: _buses_of(config), on_exit)
    except PortBusy as error:
        raise await _with_hint(error, options.socket or find_socket()) from None
    finally:
        if ending.energised is not None:
            ending.left = dict(rig.left)
    if doubtful := [f"{name} ({report.action}: {report.detail})" for name, report in rig.left.items() if not report.confirmed]:
        raise DeviceError(f"not confirmed how it was left: {', '.join(doubtful)}; check the servo before you touch it")


async def _buses_of(config: Config) -> Mapping[str, BusFacts]:
    return {name: BusFacts(bus.protocol, bus.port, bool(bus.poll.rates())) for name, bus in config.buses.items()}


async def _with_hint(error: PortBusy, daemon: str | Path | None) -> PortBusy:
    """The same error, with the next step where the daemon holds the port."""
    if daemon is None:
        return error
    try:
        async with connect(daemon) as rig:
            pid = (await rig.call("hello")).pid
    except ServobusError:
        return error
    hint = f"{error.message}; the servobus daemon (pid {pid}) owns it: leave --direct out, or stop the daemon"
    return PortBusy(hint, bus=error.bus)


@contextmanager
def _traced(config: Config, options: Options) -> Iterator[Trace | None]:
    """Makes the printer of frames. A dry run prints requests alone, on standard output unless that is JSON."""
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
