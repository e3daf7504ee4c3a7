"""Commands that open no port: check, schema, decode, ports."""

from __future__ import annotations

from typing import Any

import click

from servobus.bus.bandwidth import Bandwidth, line_bandwidth
from servobus.cli.output import echo_table, emit
from servobus.config.loader import Config, config_schema, load_config
from servobus.errors import ConfigError, UnknownName
from servobus.links import open_link
from servobus.links.ports import list_ports
from servobus.protocols.base import Codec, LineTraits
from servobus.protocols.options import BusOptions
from servobus.protocols.registry import PROTOCOLS
from servobus.simulation.link import SIMULATED


@click.command()
@click.argument("config", metavar="CONFIG")
@click.option("--json", "as_json", is_flag=True, help="For machines.")
def check(config: str, as_json: bool) -> None:
    """Validate a config and tell what its rates ask of each line.

    Shares are in percent of the line's time, for goals of all servos at `goal_rate` and for each poll. Latencies are the worst
    while every servo answers; the last column is what one silent servo adds, once. More than 100 % is an error (status 2).

    Example: servobus check config/arm.yaml
    """
    loads = loads_of(load_config(config))
    if as_json:
        emit({name: _as_dict(load) for name, load in loads.items()})
    else:
        echo_table(
            None, ("bus", "goals %", "feedback %", "health %", "load %", "goal ms", "e-stop ms", "silent ms"), _rows(loads)
        )
    heavy = [f"{name} ({load.total:.0f} %)" for name, load in loads.items() if load.total > 100]
    if heavy:
        raise ConfigError(
            f"{config}: more than the line carries: {', '.join(heavy)}; lower poll or goal_rate, or raise the baud rate"
        )
    if not as_json:
        click.echo(f"{config}: ok")


def loads_of(config: Config) -> dict[str, Bandwidth]:
    """What each bus has to carry."""
    found = {}
    for name, options in config.buses.items():
        driver = PROTOCOLS[options.protocol].driver(options, config.models[name])
        found[name] = line_bandwidth(options, driver, _traits(options))
    return found


def _traits(options: BusOptions) -> LineTraits:
    if options.port.startswith(SIMULATED):
        return LineTraits(options.baudrate)
    return open_link(options.port, options.baudrate, rs485=options.rs485).traits


def _rows(loads: dict[str, Bandwidth]) -> list[tuple[object, ...]]:
    return [
        (
            name,
            round(load.shares["goals"], 1),
            round(load.shares.get("feedback", 0.0), 1),
            round(load.shares.get("health", 0.0), 1),
            round(load.total, 1),
            round(1e3 * load.goal_latency, 2),
            round(1e3 * load.estop_latency, 2),
            round(1e3 * load.silent_latency, 1),
        )
        for name, load in loads.items()
    ]


def _as_dict(load: Bandwidth) -> dict[str, Any]:
    return {
        "load_percent": {**{name: round(share, 2) for name, share in load.shares.items()}, "total": round(load.total, 2)},
        "goal_latency_ms": round(1e3 * load.goal_latency, 3),
        "estop_latency_ms": round(1e3 * load.estop_latency, 3),
        "silent_servo_ms": round(1e3 * load.silent_latency, 3),
    }


@click.command()
def schema() -> None:
    """Print the JSON Schema of configs, for editors.

    Example: servobus schema > servobus.schema.json
    """
    emit(config_schema())


@click.command()
@click.argument("hex_bytes", metavar="HEX...", nargs=-1, required=True)
@click.option("--protocol", default="sms", show_default=True, help="Whose frames they are.")
@click.option("--request", "only", flag_value="request", help="Only as what a master says.")
@click.option("--reply", "only", flag_value="reply", help="Only as what a servo answers.")
@click.option("--json", "as_json", is_flag=True, help="For machines.")
def decode(hex_bytes: tuple[str, ...], protocol: str, only: str | None, as_json: bool) -> None:
    """Tell what a frame, or several in a row, say: as a request and as a reply, since many look like both.

    Example: servobus decode FF FF 01 02 01 FB
    """
    if protocol not in PROTOCOLS:
        raise UnknownName(f"no protocol {protocol!r}: there are {', '.join(PROTOCOLS)}")
    entry, data = PROTOCOLS[protocol], _bytes_of(" ".join(hex_bytes))
    codecs = {"request": entry.device_codec(None), "reply": entry.codec(None)}
    words = {kind: _in_words(codec, data, kind) for kind, codec in codecs.items() if only in (None, kind)}
    if as_json:
        emit({"frame": data.hex(" "), **words})
    elif len(set(words.values())) == 1:
        click.echo(next(iter(words.values())))
    else:
        for kind, line in words.items():
            click.echo(f"as a {kind}: {line}")


def _in_words(codec: Codec, data: bytes, kind: str) -> str:
    """Of each frame; of the whole where it is not frames from end to end."""
    codec.receive_data(data)
    frames = []
    while (reply := codec.next_reply()) is not None:
        frames.append(reply.frame)
    pieces = frames if b"".join(frames) == data else [data]
    return " | ".join(codec.describe(piece, sent=kind == "request") for piece in pieces)


def _bytes_of(text: str) -> bytes:
    for separator in ("0x", "0X", "\\x", ",", ":"):
        text = text.replace(separator, " ")
    try:
        data = bytes.fromhex(text)
    except ValueError:
        data = b""
    if not data:
        raise click.BadParameter(f"{text!r} is no hexadecimal text: write FF FF 01 02 01 FB or ffff010201fb", param_hint="HEX")
    return data


@click.command()
@click.option("--json", "as_json", is_flag=True, help="For machines.")
def ports(as_json: bool) -> None:
    """List the serial ports of this machine: the name to put into a config (it belongs to the adapter), the name of the socket
    it is plugged into, what it is, and who holds it.

    Example: servobus ports
    """
    found = list_ports()
    if as_json:
        emit(found)
    elif not found:
        click.echo("no serial ports; is the adapter plugged in?")
    else:
        rows = [(port.by_id or port.device, port.device, port.by_path, port.description, _held_by(port.holder)) for port in found]
        echo_table(None, ("port", "device", "by socket", "description", "held by"), rows)


def _held_by(holder: tuple[int, str] | None) -> str | None:
    return f"{holder[1]} ({holder[0]})" if holder else None
