"""The command that looks for servos."""

from __future__ import annotations

import dataclasses
import io
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap

from servobus.config import Config, parse_config
from servobus.doors.cli.common import Options, echo_table, emit, logs, run, servo_options, simulated, traced
from servobus.errors import ServobusError, UnknownName
from servobus.opening import open_rig
from servobus.protocols.table import PROTOCOLS
from servobus.rig import Found

INTERRUPTED, NONE_FOUND = 130, 1
LEAST_RATE, GREATEST_RATE = 300, 10_000_000
BUS = "line"
"""What the bus of a bare port is called."""
HEAD = "# Written by `servobus scan --yaml`. Give the servos names of yours, and limits before anything moves.\n"


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
    """Ask every id, at every rate wanted, who is there. Needs the line alone; moves and writes nothing.

    Ctrl-C ends it early and tells what was found until then. Status 1 when nobody answered.

    Example: servobus scan --port /dev/ttyUSB0 --protocol sms --baudrate 1000000,115200 --ids 1-20
    """
    if port and bus:
        raise click.UsageError(f"say a bus of the config ({bus}) or --port, not both")
    logs()
    config = _bare(port, protocol, rates) if port else options.setup
    if port and options.dry_run:
        config = simulated(config)
    name = _bus_name(config, BUS if port else bus)
    entry = PROTOCOLS[config.buses[name].protocol]
    found: list[Found] = []
    try:
        status = _scan(options, config, name, _rates(rates, entry.baudrates, bool(port)), _ids(ids, entry.scan_ids), found)
    except ServobusError:
        if found:
            _tell(options, config, name, found, as_yaml)
        raise
    _tell(options, config, name, found, as_yaml)
    return status or (0 if found else NONE_FOUND)


def _scan(options: Options, config: Config, name: str, rates: list[int], ids: list[int], found: list[Found]) -> int:
    """Fills `found`; returns the status of an interrupted scan, else 0."""

    async def main() -> None:
        async with traced(config, options) as trace, open_rig(config, buses=[name], trace=trace) as rig:
            with _progress() as told:

                def progress(asked: int, count: int, hit: Found | None) -> None:
                    if hit is not None:
                        found.append(hit)
                    told(asked, count, len(found))

                await rig.scan(name, baudrates=rates, ids=ids, progress=progress)

    try:
        run(main)
    except KeyboardInterrupt:
        return INTERRUPTED
    return 0


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


def _bare(port: str, protocol: str, rates: str | None) -> Config:
    """A config of one line without servos."""
    if protocol not in PROTOCOLS:
        raise UnknownName(f"no protocol {protocol!r}: there are {', '.join(PROTOCOLS)}")
    first = _rates(rates, PROTOCOLS[protocol].baudrates, True)[0]
    quoted = "'" + port.replace("'", "''") + "'"
    text = f"version: 1\nbuses:\n  {BUS}: {{protocol: {protocol}, port: {quoted}, baudrate: {first}}}\n"
    return parse_config(text, "--port")


def _bus_name(config: Config, bus: str | None) -> str:
    if bus is None and len(config.buses) == 1:
        return next(iter(config.buses))
    if bus is None or bus not in config.buses:
        said = "say which bus" if bus is None else f"no bus {bus!r}"
        raise UnknownName(f"{said}: there are {', '.join(config.buses)}")
    return bus


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
    if not rates or min(rates) < LEAST_RATE or max(rates) > GREATEST_RATE:
        raise click.BadParameter(
            f"{text!r}: write rates from {LEAST_RATE} to {GREATEST_RATE} like 1000000,115200, or all", param_hint="--baudrate"
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


def _tell(options: Options, config: Config, name: str, found: list[Found], as_yaml: bool) -> None:
    if options.as_json:
        emit([dataclasses.asdict(hit) for hit in found])
    elif not found:
        click.echo("nobody answered: is the power on, are the baud rates right, is another program on the line?", err=True)
    elif as_yaml:
        click.echo(starter(config, name, found), nl=False)
    else:
        rows = [(hit.id, hit.baudrate, hit.model, hit.product, hit.firmware, hit.note or None) for hit in found]
        echo_table(None, ("id", "baud rate", "model", "product", "firmware", "note"), rows)


def starter(config: Config, name: str, found: list[Found]) -> str:
    """A config of what was found, that `check` accepts. A line has one rate, and a servo needs a model: what stands against
    that is told in comments."""
    options = config.buses[name]
    rate = max((hit.baudrate for hit in found), key=lambda rate: sum(hit.baudrate == rate for hit in found))
    usable = [hit for hit in found if hit.baudrate == rate and hit.model]
    write = PROTOCOLS[options.protocol].starter
    entries = (entry for hit in usable for entry in write(hit.id, hit.model or "").items())
    servos = CommentedMap((servo, CommentedMap(keys)) for servo, keys in entries)
    for servo in servos.values():
        servo.fa.set_flow_style()
    bus = CommentedMap(protocol=options.protocol, port=options.port, baudrate=rate, poll=CommentedMap(feedback=20), servos=servos)
    bus["poll"].fa.set_flow_style()
    if not servos:
        servos.fa.set_flow_style()
    text = io.StringIO()
    YAML().dump(CommentedMap(version=1, buses=CommentedMap({name: bus})), text)
    notes = "".join(
        f"# Not in it: id {hit.id} at {hit.baudrate} baud, {_why_not(hit, rate)}\n" for hit in found if hit not in usable
    )
    return f"{HEAD}{notes}{text.getvalue()}"


def _why_not(hit: Found, rate: int) -> str:
    if hit.baudrate != rate:
        return f"{hit.model or 'unknown model'}: a line has one rate, and most servos here answer at {rate}"
    return f"no model file fits it ({hit.note or hit.product or 'it does not say who it is'}): name one, or write your own"
