"""One scan from the command line: which line, rates and ids, and the hits so far."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from servobus.cli.ending import INTERRUPTED
from servobus.cli.options import Options, RigContext, on_rig
from servobus.cli.scan import ScanTarget
from servobus.config.loader import Config, parse_config
from servobus.errors import UnknownName
from servobus.protocols.registry import PROTOCOLS
from servobus.values import ScanHit

MIN_RATE, MAX_RATE = 300, 10_000_000
BUS = "line"  # name of the bus of a bare port


class Search:
    """A scan of a bus of the config, or of a bare port; `hits` grows while it runs."""

    def __init__(
        self, options: Options, bus: str | None, port: str | None, protocol: str, rates: str | None, ids: str | None
    ) -> None:
        self.hits: list[ScanHit] = []
        self.target = ScanTarget(bus or "", "", "")  # complete when a rig was reached; for a bare port from the beginning
        self._options, self._bus, self._rates, self._ids = options, bus, rates, ids
        self._bare = bool(port)
        if port:
            self.target = ScanTarget(BUS, protocol, port)
            self._options = replace(options, parsed=_bare_config(self.target, rates), direct=True)

    def run(self) -> int:
        """Returns the exit status of an interrupted scan, else 0."""
        only = [self._bus] if self._bus and not self._bare else []
        try:
            on_rig(self._options, self._scan, only=only, before=self._check)
        except KeyboardInterrupt:
            return INTERRUPTED
        return 0

    async def _scan(self, context: RigContext) -> None:
        buses = await context.buses()
        self._choose({name: ScanTarget(name, bus.protocol, bus.port) for name, bus in buses.items()})
        rates, ids = self._ranges()
        with _progress() as show_progress:

            def progress(asked: int, count: int, hit: ScanHit | None) -> None:
                if hit is not None:
                    self.hits.append(hit)
                show_progress(asked, count, len(self.hits))

            await context.rig.scan(self.target.bus, baudrates=rates, ids=ids, progress=progress)

    def _check(self, config: Config) -> None:
        """Raises UnknownName or BadParameter before a port is opened."""
        self._choose({name: ScanTarget(name, bus.protocol, bus.port) for name, bus in config.buses.items()})
        self._ranges()

    def _choose(self, targets: Mapping[str, ScanTarget]) -> None:
        if self._bus is None and len(targets) == 1:
            (self.target,) = targets.values()
        elif self._bus is None or self._bus not in targets:
            problem = "say which bus" if self._bus is None else f"no bus {self._bus!r}"
            raise UnknownName(f"{problem}: there are {', '.join(targets)}")
        else:
            self.target = targets[self._bus]

    def _ranges(self) -> tuple[list[int], list[int]]:
        definition = PROTOCOLS[self.target.protocol]
        return parse_rates(self._rates, definition.baudrates, self._bare), parse_ids(self._ids, definition.scan_ids)


@contextmanager
def _progress() -> Iterator[Callable[[int, int, int], object]]:
    """Shows a progress bar on a terminal, and nothing elsewhere."""
    if not sys.stderr.isatty():
        yield lambda asked, count, hits: None
        return
    bar_columns = (TextColumn("scanning"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    columns = (*bar_columns, TextColumn("{task.fields[hits]} found"))
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("scan", total=None, hits=0)
        yield lambda asked, count, hits: bar.update(task, completed=asked, total=count, hits=hits)


def _bare_config(target: ScanTarget, rates: str | None) -> Config:
    """A config of one bus without servos."""
    if target.protocol not in PROTOCOLS:
        raise UnknownName(f"no protocol {target.protocol!r}: there are {', '.join(PROTOCOLS)}")
    first = parse_rates(rates, PROTOCOLS[target.protocol].baudrates, True)[0]
    quoted = "'" + target.port.replace("'", "''") + "'"
    text = f"version: 1\nbuses:\n  {target.bus}: {{protocol: {target.protocol}, port: {quoted}, baudrate: {first}}}\n"
    return parse_config(text, "--port")


def parse_rates(text: str | None, usual: tuple[int, ...], bare: bool) -> list[int]:
    """The rates to try; an empty list means the rate of the bus."""
    if text == "all" or (text is None and bare):
        return list(usual)
    if text is None:
        return []
    try:
        rates = list(dict.fromkeys(int(part) for part in text.split(",")))
    except ValueError:
        rates = []
    if not rates or min(rates) < MIN_RATE or max(rates) > MAX_RATE:
        raise click.BadParameter(
            f"{text!r}: write rates from {MIN_RATE} to {MAX_RATE} like 1000000,115200, or all", param_hint="--baudrate"
        )
    return rates


def parse_ids(text: str | None, allowed: range) -> list[int]:
    """The ids to ask; an empty list means all. A broadcast id is refused, because the replies would collide."""
    if text is None:
        return []
    first, dash, last = text.partition("-")
    try:
        low, high = int(first, 0), int(last, 0) if dash else int(first, 0)
    except ValueError:
        low, high = 1, 0
    if not allowed[0] <= low <= high <= allowed[-1]:
        raise click.BadParameter(f"{text!r}: write ids from {allowed[0]} to {allowed[-1]} like 1-20, or 5", param_hint="--ids")
    return list(range(low, high + 1))
