"""Commands that ask servos and write single registers: ping, read, write."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

import click

import servobus
from servobus.cli.options import Options, RigContext, on_rig, parse_pairs, servo_options
from servobus.cli.output import STATE_COLUMNS, echo, echo_table, emit, report, show, state_row
from servobus.errors import ServobusError

VALUE = "REGISTER=VALUE"


@click.command()
@click.argument("names", metavar="[NAME]...", nargs=-1)
@servo_options
def ping(options: Options, names: tuple[str, ...]) -> int:
    """Ask servos whether they answer. Shows the faults that they report. Without a NAME all servos are asked.

    Example: servobus ping shoulder elbow
    """

    async def action(context: RigContext) -> int:
        rig = context.rig
        results = await _each(rig, names, rig.ping)
        errors = {name: result.message for name, result in results.items() if isinstance(result, ServobusError)}
        data = {name: {"error": errors[name]} if name in errors else {"status": status} for name, status in results.items()}
        rows = [(name, errors.get(name) or _answer(rig, name)) for name in results]
        report(options.as_json, data, ("servo", "answer"), rows)
        return 1 if errors else 0

    return on_rig(options, action, names)


def _answer(rig: servobus.Rig, name: str) -> str:
    faults = rig.snapshot()[name].faults
    return f"there, but {', '.join(faults)}" if faults else "there"


async def _each(rig: servobus.Rig, names: tuple[str, ...], verb: Callable[[str], Awaitable[Any]]) -> dict[str, Any]:
    """The result or the error of each servo."""
    results: dict[str, Any] = {}
    for name in rig.full_names(names):
        try:
            results[name] = await verb(name)
        except ServobusError as error:
            results[name] = error
    return results


@click.command()
@click.argument("name", required=False)
@click.argument("register", metavar="[REGISTER|ADDR:LEN]", required=False)
@click.option("--raw", is_flag=True, help="Print the integer in the register instead of the physical value.")
@servo_options
def read(options: Options, name: str | None, register: str | None, raw: bool) -> int:
    """Read the state of servos, or one register of a servo. Without a NAME all servos are read.

    Positions are in the servo's unit, speed in unit/s, load in percent, then volts, degrees Celsius and amperes. A register has a
    name or an alias (temperature, present_position); ADDR:LEN prints LEN bytes from the address ADDR.

    Example: servobus read elbow temperature
    """

    async def action(context: RigContext) -> int:
        if name and register:
            return await _read_register(context.rig, options, context.rig.full_name(name), register, raw)
        return await _read_states(context.rig, options, (name,) if name else ())

    return on_rig(options, action, [name] if name else [])


async def _read_register(rig: servobus.Rig, options: Options, name: str, register: str, raw: bool) -> int:
    value = await rig.read_register(name, register, raw=raw)
    if options.as_json:
        emit({name: {register: value}})
    else:
        echo(" ".join(f"{byte:02X}" for byte in value) if isinstance(value, list) else show(value))
    return 0


async def _read_states(rig: servobus.Rig, options: Options, names: tuple[str, ...]) -> int:
    results = await _each(rig, names, rig.read)
    errors = {name: result for name, result in results.items() if isinstance(result, ServobusError)}
    if options.as_json:
        emit({name: {"error": result.message} if name in errors else result for name, result in results.items()})
        return 1 if errors else 0
    rows = [state_row(name, state) for name, state in results.items() if name not in errors]
    if rows:
        echo_table(None, STATE_COLUMNS, rows, narrow=True)
    for error in errors.values():
        echo(f"servobus: {error}", err=True)
    return 1 if errors else 0


@click.command()
@click.argument("name")
@click.argument("assignments", metavar=f"{VALUE}...", nargs=-1, required=True)
@click.option("--raw", is_flag=True, help="VALUE is the integer in the register instead of the physical value.")
@click.option("--persist", is_flag=True, help="Allow EEPROM registers: each is unlocked, written, read back and locked again.")
@servo_options
def write(options: Options, name: str, assignments: tuple[str, ...], raw: bool, persist: bool) -> None:
    """Write registers of a servo, and read them back.

    VALUE is in the register's own unit, or a name that the register knows. Without a daemon all values are checked before the
    first one is written; a daemon checks each one when its turn comes. Goals, torque and lock are refused: use move, enable and
    disable.

    Example: servobus write elbow torque_limit=60
    """
    values = {register: number_or_name(text) for register, text in parse_pairs(assignments, VALUE, "torque_limit=60").items()}

    def check(config: Any) -> None:
        from servobus.cli.checks import check_registers

        check_registers(config, name, values, raw=raw, persist=persist)

    async def action(context: RigContext) -> None:
        full = context.rig.full_name(name)
        written = {
            register: await context.rig.write_register(full, register, value, raw=raw, persist=persist)
            for register, value in values.items()
        }
        if options.as_json:
            emit({full: written})
        else:
            for register, value in written.items():
                echo(f"{full} {register} = {show(value)}")

    on_rig(options, action, [name], before=check)


def number_or_name(text: str) -> int | float | str:
    """A decimal or hexadecimal (0x...) number; any other text as it is."""
    for parse in (lambda text: int(text, 0), float):
        try:
            return parse(text)
        except ValueError:
            continue
    return text
