"""Commands that open no port: check, schema, decode, ports."""

from __future__ import annotations

from typing import Any

import click

from servobus.cli.options import json_option
from servobus.cli.output import echo, emit, report
from servobus.errors import ConfigError, UnknownName

LOAD_COLUMNS = ("bus", "goals %", "feedback %", "health %", "load %", "goal ms", "e-stop ms", "silent ms")


@click.command()
@click.argument("config", metavar="CONFIG")
@json_option
def check(config: str, as_json: bool) -> None:
    """Validate a config and print the load of each line.

    Loads are in percent of the line's time: goals for all servos at `goal_rate`, and each poll. "goal ms" and "e-stop ms" are the
    longest waits while every servo answers; "silent ms" is what one silent servo adds, once. A load over 100 % is an error (exit
    status 2).

    Example: servobus check config/arm.yaml
    """
    from servobus.cli.checks import line_loads
    from servobus.config.loader import load_config

    loads = line_loads(load_config(config))
    data = {name: _load_as_dict(load) for name, load in loads.items()}
    report(as_json, data, LOAD_COLUMNS, [_load_row(name, load) for name, load in loads.items()])
    if overloaded := [f"{name} ({load.total:.0f} %)" for name, load in loads.items() if load.total > 100]:
        problem = f"more than the line carries: {', '.join(overloaded)}"
        raise ConfigError(f"{config}: {problem}; lower poll or goal_rate, or raise the baud rate")
    if not as_json:
        echo(f"{config}: ok")


def _load_row(name: str, load: Any) -> tuple[object, ...]:
    return (
        name,
        *(round(load.shares.get(kind, 0.0), 1) for kind in ("goals", "feedback", "health")),
        round(load.total, 1),
        round(1e3 * load.goal_latency, 2),
        round(1e3 * load.estop_latency, 2),
        round(1e3 * load.silent_latency, 1),
    )


def _load_as_dict(load: Any) -> dict[str, Any]:
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
    from servobus.config.schema import config_schema

    emit(config_schema())


@click.command()
@click.argument("hex_bytes", metavar="HEX...", nargs=-1, required=True)
@click.option("--protocol", default="sms", show_default=True, help="Protocol of the frames: sms, kst or roh.")
@click.option("--request", "only", flag_value="request", help="Explain them as requests of a master alone.")
@click.option("--reply", "only", flag_value="reply", help="Explain them as replies of a servo alone.")
@json_option
def decode(hex_bytes: tuple[str, ...], protocol: str, only: str | None, as_json: bool) -> None:
    """Explain the frames in some bytes. Prints them as requests and as replies, since many bytes can be either.

    HEX is hexadecimal text, with or without spaces, commas or 0x.

    Example: servobus decode FF FF 01 02 01 FB
    """
    from servobus.protocols.registry import PROTOCOLS

    if protocol not in PROTOCOLS:
        raise UnknownName(f"no protocol {protocol!r}: there are {', '.join(PROTOCOLS)}")
    definition, data = PROTOCOLS[protocol], _bytes_of(" ".join(hex_bytes))
    codecs = {"request": definition.device_codec(None), "reply": definition.codec(None)}
    texts = {kind: _describe(codec, data, kind) for kind, codec in codecs.items() if only in (None, kind)}
    if as_json:
        emit({"frame": data.hex(" "), **texts})
    elif len(set(texts.values())) == 1:
        echo(next(iter(texts.values())))
    else:
        for kind, text in texts.items():
            echo(f"as a {kind}: {text}")


def _describe(codec: Any, data: bytes, kind: str) -> str:
    """Describes each frame; where the data is not frames from end to end, describes it as a whole."""
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
        raise click.BadParameter(f"{text!r} is not hexadecimal text: write FF FF 01 02 01 FB or ffff010201fb", param_hint="HEX")
    return data


@click.command()
@json_option
def ports(as_json: bool) -> None:
    """List the serial ports of this machine.

    "port" is the name for a config: it belongs to the adapter. "by socket" belongs to the socket that the adapter is plugged
    into; use it for adapters without a serial number. "held by" is the program that has the port open, with its process id.

    Example: servobus ports
    """
    from servobus.links.ports import list_ports

    listed = list_ports()
    if not listed and not as_json:
        echo("no serial ports; is the adapter plugged in?")
        return
    rows = [(port.by_id or port.device, port.device, port.by_path, port.description, _holder(port.holder)) for port in listed]
    report(as_json, listed, ("port", "device", "by socket", "description", "held by"), rows)


def _holder(holder: tuple[int, str] | None) -> str | None:
    return f"{holder[1]} ({holder[0]})" if holder else None
