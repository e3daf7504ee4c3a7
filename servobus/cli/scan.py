"""The command that searches a line for servos: scan."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import click

import servobus
from servobus.cli.options import Options, servo_options
from servobus.cli.output import echo, echo_table, emit
from servobus.errors import ServobusError

NO_ANSWER = 1  # the exit status of a scan that finds nothing
COLUMNS = ("id", "baud rate", "model", "product", "firmware", "note")


@click.command()
@click.argument("bus", required=False)
@click.option("--port", help="Scan this port instead of a bus of the config: a device file, tcp://HOST:PORT or sim:.")
@click.option("--protocol", default="sms", show_default=True, help="Protocol on --port: sms, kst or roh.")
@click.option(
    "--baudrate",
    "rates",
    metavar="N,...|all",
    help="Baud rates to try, in bits/s. Default: the rate of the bus; with --port all rates of the protocol.",
)
@click.option("--ids", metavar="A-B", help="Ids to ask. Default: all.")
@click.option("--yaml", "as_yaml", is_flag=True, help="Print a config for the servos that answered.")
@servo_options
def scan(
    options: Options, bus: str | None, port: str | None, protocol: str, rates: str | None, ids: str | None, as_yaml: bool
) -> int:
    """Search a line for servos. Asks every id at every baud rate; polls pause meanwhile; moves and writes nothing.

    BUS is a bus of the config; it may be omitted where the config has one. Ctrl-C ends the scan and prints what answered until
    then. The exit status is 1 when nothing answered.

    Example: servobus scan --port /dev/ttyUSB0 --protocol sms --baudrate 1000000,115200 --ids 1-20
    """
    if port and bus:
        raise click.UsageError(f"give a bus of the config ({bus}) or --port, not both")
    from servobus.cli.scan_search import Search

    search = Search(options, bus, port, protocol, rates, ids)
    try:
        status = search.run()
    except ServobusError:
        if search.hits:
            _print(options, search.target, search.hits, as_yaml)
        raise
    _print(options, search.target, search.hits, as_yaml)
    return status or (0 if search.hits else NO_ANSWER)


@dataclasses.dataclass(frozen=True)
class ScanTarget:
    """The line that is scanned."""

    bus: str
    protocol: str
    port: str


def _print(options: Options, target: ScanTarget, hits: Sequence[servobus.ScanHit], as_yaml: bool) -> None:
    if options.as_json:
        emit([dataclasses.asdict(hit) for hit in hits])
    elif not hits:
        echo("no servo answered: check the power, the baud rates, and whether another program uses the line", err=True)
    elif as_yaml:
        from servobus.cli.starter import starter

        echo(starter(target, hits), end="")
    else:
        rows = [(hit.id, hit.baudrate, hit.model, hit.product, hit.firmware, hit.note or None) for hit in hits]
        echo_table(None, COLUMNS, rows)
