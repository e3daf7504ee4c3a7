"""The command that looks for servos."""

from __future__ import annotations

import dataclasses
import io
import sys
from collections.abc import AsyncIterator, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass, replace
from typing import Any

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap

from servobus.cli.output import echo_table, emit, logs, run
from servobus.cli.rig_context import Options, opened, servo_options
from servobus.config.loader import Config, parse_config
from servobus.errors import ServobusError, UnknownName
from servobus.protocols.registry import PROTOCOLS
from servobus.remote.rig import RemoteRig
from servobus.rig.interface import Rig
from servobus.values import ScanHit

INTERRUPTED, NONE_FOUND = 130, 1
MIN_RATE, MAX_RATE = 300, 10_000_000
BUS = "line"
"""What the bus of a bare port is called."""
HEAD = "# Written by `servobus scan --yaml`. Give the servos names of yours, and limits before anything moves.\n"


@dataclass(frozen=True)
class Line:
    """What is scanned."""

    name: str
    protocol: str
    port: str


@click.command()
@click.argument("bus", required=False)
@click.option("--port", help="Scan this port instead of a bus of the config.")
@click.option("--protocol", default="sms", show_default=True, help="What is spoken on --port.")
@click.option(
    "--baudrate", "rates", metavar="N,...|all", help="Rates to try. Default: the bus's own; with --port all of the protocol's."
)
@click.option("--ids", metavar="A-B", help="Ids to ask. Default: every one.")
@click.option("--yaml", "as_yaml", is_flag=True, help="Print a starter config of what was found.")
@servo_options
def scan(
    options: Options, bus: str | None, port: str | None, protocol: str, rates: str | None, ids: str | None, as_yaml: bool
) -> int:
    """Ask every id, at every rate wanted, who is there. Polls rest meanwhile; moves and writes nothing.

    Ctrl-C ends it early and tells what was found until then. Status 1 when nobody answered.

    Example: servobus scan --port /dev/ttyUSB0 --protocol sms --baudrate 1000000,115200 --ids 1-20
    """
    if port and bus:
        raise click.UsageError(f"say a bus of the config ({bus}) or --port, not both")
    logs()
    search = Search(options, bus, port, protocol, rates, ids)
    try:
        status = search.run()
    except ServobusError:
        if search.found:
            _tell(options, search.line, search.found, as_yaml)
        raise
    _tell(options, search.line, search.found, as_yaml)
    return status or (0 if search.found else NONE_FOUND)


class Search:
    """One scan: what was asked for, and what was found so far."""

    def __init__(
        self, options: Options, bus: str | None, port: str | None, protocol: str, rates: str | None, ids: str | None
    ) -> None:
        self.found: list[ScanHit] = []
        self._options = options
        self._bus = bus
        self._rates = rates
        self._ids = ids
        self._bare = bool(port)
        self.line = Line(BUS, protocol, port) if port else Line("", "", "")
        """Known from the beginning with a bare port; else when a rig is reached."""

    def run(self) -> int:
        """Returns the status of an interrupted scan, else 0."""
        try:
            run(self._run)
        except KeyboardInterrupt:
            return INTERRUPTED
        return 0

    async def _run(self) -> None:
        async with self._rig() as rig:
            entry = PROTOCOLS[self.line.protocol]
            rates, ids = _rates(self._rates, entry.baudrates, self._bare), _ids(self._ids, entry.scan_ids)
            with _progress() as told:

                def progress(asked: int, count: int, hit: ScanHit | None) -> None:
                    if hit is not None:
                        self.found.append(hit)
                    told(asked, count, len(self.found))

                await rig.scan(self.line.name, baudrates=rates, ids=ids, progress=progress)

    @asynccontextmanager
    async def _rig(self) -> AsyncIterator[Rig]:
        """What has the line: this process for a bare port, else as for every command."""
        if self._bare:
            options = replace(self._options, bare=_bare(self.line, self._rates), direct=True)
            async with opened(options, before=self._check) as rig:
                yield rig
            return
        only = [] if self._bus is None else [self._bus]
        async with opened(self._options, only=only, before=self._check) as rig:
            if isinstance(rig, RemoteRig):
                buses = (await rig.call("config"))["buses"]
                self._choose({name: Line(name, bus["protocol"], bus["port"]) for name, bus in buses.items()})
            yield rig

    def _check(self, config: Config) -> None:
        """Before a port is opened: UnknownName, BadParameter."""
        self._choose({name: Line(name, bus.protocol, bus.port) for name, bus in config.buses.items()})
        entry = PROTOCOLS[self.line.protocol]
        _rates(self._rates, entry.baudrates, self._bare)
        _ids(self._ids, entry.scan_ids)

    def _choose(self, lines: Mapping[str, Line]) -> None:
        if self._bus is None and len(lines) == 1:
            (self.line,) = lines.values()
        elif self._bus is None or self._bus not in lines:
            said = "say which bus" if self._bus is None else f"no bus {self._bus!r}"
            raise UnknownName(f"{said}: there are {', '.join(lines)}")
        else:
            self.line = lines[self._bus]


@contextmanager
def _progress() -> Iterator[Any]:
    """A bar on a terminal; nothing elsewhere."""
    if not sys.stderr.isatty():
        yield lambda asked, count, found: None
        return
    columns = (
        TextColumn("scanning"),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[found]} found"),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("scan", total=None, found=0)
        yield lambda asked, count, found: bar.update(task, completed=asked, total=count, found=found)


def _bare(line: Line, rates: str | None) -> Config:
    """A config of one line without servos."""
    if line.protocol not in PROTOCOLS:
        raise UnknownName(f"no protocol {line.protocol!r}: there are {', '.join(PROTOCOLS)}")
    first = _rates(rates, PROTOCOLS[line.protocol].baudrates, True)[0]
    quoted = "'" + line.port.replace("'", "''") + "'"
    text = f"version: 1\nbuses:\n  {line.name}: {{protocol: {line.protocol}, port: {quoted}, baudrate: {first}}}\n"
    return parse_config(text, "--port")


def _rates(text: str | None, known: tuple[int, ...], bare: bool) -> list[int]:
    """The rates to try; none: the bus's own."""
    if text == "all" or (text is None and bare):
        return list(known)
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


def _ids(text: str | None, known: range) -> list[int]:
    """The ids to ask; none: every one. Not those that mean everybody: their answers would collide."""
    if text is None:
        return []
    first, dash, last = text.partition("-")
    try:
        low, high = int(first, 0), int(last, 0) if dash else int(first, 0)
    except ValueError:
        low, high = 1, 0
    if not known[0] <= low <= high <= known[-1]:
        raise click.BadParameter(f"{text!r}: write ids from {known[0]} to {known[-1]} like 1-20, or 5", param_hint="--ids")
    return list(range(low, high + 1))


def _tell(options: Options, line: Line, found: list[ScanHit], as_yaml: bool) -> None:
    if options.as_json:
        emit([dataclasses.asdict(hit) for hit in found])
    elif not found:
        click.echo("nobody answered: is the power on, are the baud rates right, is another program on the line?", err=True)
    elif as_yaml:
        click.echo(starter(line, found), nl=False)
    else:
        rows = [(hit.id, hit.baudrate, hit.model, hit.product, hit.firmware, hit.note or None) for hit in found]
        echo_table(None, ("id", "baud rate", "model", "product", "firmware", "note"), rows)


def starter(line: Line, found: list[ScanHit]) -> str:
    """A config of what was found, that `check` accepts. A line has one rate, and a servo needs a model: what stands against
    that is told in comments."""
    rate = max((hit.baudrate for hit in found), key=lambda rate: sum(hit.baudrate == rate for hit in found))
    usable = [hit for hit in found if hit.baudrate == rate and hit.model]
    write = PROTOCOLS[line.protocol].starter
    entries = (entry for hit in usable for entry in write(hit.id, hit.model or "").items())
    servos = CommentedMap((servo, CommentedMap(keys)) for servo, keys in entries)
    for servo in servos.values():
        servo.fa.set_flow_style()
    bus = CommentedMap(protocol=line.protocol, port=line.port, baudrate=rate, poll=CommentedMap(feedback=20), servos=servos)
    bus["poll"].fa.set_flow_style()
    if not servos:
        servos.fa.set_flow_style()
    text = io.StringIO()
    YAML().dump(CommentedMap(version=1, buses=CommentedMap({line.name: bus})), text)
    notes = "".join(
        f"# Not in it: id {hit.id} at {hit.baudrate} baud, {_why_not(hit, rate)}\n" for hit in found if hit not in usable
    )
    return f"{HEAD}{notes}{text.getvalue()}"


def _why_not(hit: ScanHit, rate: int) -> str:
    if hit.baudrate != rate:
        return f"{hit.model or 'unknown model'}: a line has one rate, and most servos here answer at {rate}"
    return f"no model file fits it ({hit.note or hit.product or 'it does not say who it is'}): name one, or write your own"
