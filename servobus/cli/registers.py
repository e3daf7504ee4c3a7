"""Commands that ask servos and write single registers: ping, read, write."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterable, Mapping
from typing import Any

import click

from servobus.cli.output import STATE_COLUMNS, echo_table, emit, logs, run, show, state_row
from servobus.cli.rig_context import Options, opened, servo_options
from servobus.config.loader import Config
from servobus.errors import ServobusError
from servobus.protocols.registry import PROTOCOLS
from servobus.rig.interface import Rig, full_name


@click.command()
@click.argument("names", metavar="[NAME]...", nargs=-1)
@servo_options
def ping(options: Options, names: tuple[str, ...]) -> int:
    """Ask servos whether they are there, and for their health byte. All of them if none is named.

    Example: servobus ping shoulder elbow
    """
    logs()

    async def main() -> int:
        async with opened(options, names) as rig:
            answers = await _each(rig, names, rig.ping)
            failed = {name: answer.message for name, answer in answers.items() if isinstance(answer, ServobusError)}
            if options.as_json:
                emit(
                    {name: {"error": failed[name]} if name in failed else {"status": answer} for name, answer in answers.items()}
                )
            else:
                echo_table(None, ("servo", "answer"), [(name, failed.get(name) or _health(rig, name)) for name in answers])
            return 1 if failed else 0

    return run(main)


def _health(rig: Rig, name: str) -> str:
    faults = rig.snapshot()[name].faults
    return f"there, but {', '.join(faults)}" if faults else "there"


async def _each(rig: Rig, names: tuple[str, ...], verb: Callable[[str], Awaitable[Any]]) -> dict[str, Any]:
    """The answer or the error of each servo."""
    answers: dict[str, Any] = {}
    for name in rig.full_names(names):
        try:
            answers[name] = await verb(name)
        except ServobusError as error:
            answers[name] = error
    return answers


@click.command()
@click.argument("name", required=False)
@click.argument("register", metavar="[REGISTER|ADDR:LEN]", required=False)
@click.option("--raw", is_flag=True, help="The integer in the register instead of the physical value.")
@servo_options
def read(options: Options, name: str | None, register: str | None, raw: bool) -> int:
    """Read the state of all servos, the state of one, or one register of one.

    Positions in the servo's unit, speed in unit/s, load in percent, V, A, degrees Celsius. A register goes by name or alias
    (temperature, present_position), or as ADDR:LEN for the bytes themselves.

    Example: servobus read elbow temperature
    """
    logs()

    async def main() -> int:
        async with opened(options, [name] if name else []) as rig:
            if name and register:
                return await _read_register(rig, options, rig.full_name(name), register, raw)
            return await _read_states(rig, options, (name,) if name else ())

    return run(main)


async def _read_register(rig: Rig, options: Options, name: str, register: str, raw: bool) -> int:
    value = await rig.read_register(name, register, raw=raw)
    if options.as_json:
        emit({name: {register: value}})
    else:
        click.echo(" ".join(f"{byte:02X}" for byte in value) if isinstance(value, list) else show(value))
    return 0


async def _read_states(rig: Rig, options: Options, names: tuple[str, ...]) -> int:
    answers = await _each(rig, names, rig.read)
    failed = {name: answer for name, answer in answers.items() if isinstance(answer, ServobusError)}
    if options.as_json:
        emit({name: {"error": answer.message} if name in failed else answer for name, answer in answers.items()})
        return 1 if failed else 0
    rows = [state_row(name, state) for name, state in answers.items() if name not in failed]
    if rows:
        echo_table(None, STATE_COLUMNS, rows, narrow=True)
    for error in failed.values():
        click.echo(f"servobus: {error}", err=True)
    return 1 if failed else 0


@click.command()
@click.argument("name")
@click.argument("assignments", metavar="REGISTER=VALUE...", nargs=-1, required=True)
@click.option("--raw", is_flag=True, help="VALUE is the integer in the register instead of the physical value.")
@click.option("--persist", is_flag=True, help="Allow EEPROM registers: they are unlocked, written, read back and locked again.")
@servo_options
def write(options: Options, name: str, assignments: tuple[str, ...], raw: bool, persist: bool) -> int:
    """Write registers of one servo, and read back what they hold then. Without a daemon all are checked before the first is
    written; a daemon checks each when its turn comes.

    Goals, torque and lock are not written by hand: use move, enable and disable.

    Example: servobus write elbow torque_limit=60
    """
    logs()
    wanted = _wanted(assignments)

    def refuse(config: Config) -> None:
        _refuse(config, name, wanted, raw=raw, persist=persist)

    async def main() -> int:
        async with opened(options, [name], before=refuse) as rig:
            full = rig.full_name(name)
            found = {
                register: await rig.write_register(full, register, value, raw=raw, persist=persist)
                for register, value in wanted.items()
            }
            if options.as_json:
                emit({full: found})
            else:
                for register, value in found.items():
                    click.echo(f"{full} {register} = {show(value)}")
            return 0

    return run(main)


def _wanted(assignments: Iterable[str]) -> dict[str, Any]:
    """Register -> value."""
    wanted: dict[str, Any] = {}
    for register, value in map(_assignment, assignments):
        if register in wanted:
            raise click.BadParameter(f"{register} is named twice: give each register one value", param_hint="REGISTER=VALUE")
        wanted[register] = value
    return wanted


def _refuse(config: Config, name: str, wanted: Mapping[str, Any], *, raw: bool, persist: bool) -> None:
    """Before the first is written: LimitError, UnknownName, NotSupported."""
    bus, servo = config.names[full_name(config.names, name)]
    options = config.buses[bus]
    driver = PROTOCOLS[options.protocol].driver(options, config.models[bus])
    for register, value in wanted.items():
        try:
            driver.write_register(servo, register, value, raw=raw, persist=persist).close()
        except ServobusError as error:
            raise error.at(bus=bus, servo=servo) from None


def _assignment(text: str) -> tuple[str, Any]:
    register, equals, value = text.partition("=")
    if not (register and equals and value):
        raise click.BadParameter(f"{text!r}: write REGISTER=VALUE", param_hint="REGISTER=VALUE")
    return register, number_or_word(value)


def number_or_word(text: str) -> int | float | str:
    """A number as people write it, hexadecimal too; else the word."""
    for kind in (lambda value: int(value, 0), float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
