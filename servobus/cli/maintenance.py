"""Commands that change a servo for good: set-id, set-baud, command."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

import click

import servobus
from servobus.cli.options import Options, RigContext, on_rig, servo_options
from servobus.cli.output import echo, emit
from servobus.errors import UnknownName
from servobus.values import Change

ID = click.IntRange(0, 255)
SAVE = "Save the change in the servo's flash; otherwise a restart of the servo forgets it."


@click.command("set-id")
@click.argument("bus")
@click.argument("old", type=ID)
@click.argument("new", type=ID)
@click.option("--save", is_flag=True, help=SAVE)
@servo_options
def set_id(options: Options, bus: str, old: int, new: int, save: bool) -> None:
    """Change the id of a servo. The servo with id OLD on BUS, a bus of the config, gets the id NEW.

    Refused while a servo of the bus is enabled, when two servos seem to answer at OLD, or when one answers at NEW. Moves nothing.
    Write the new id into the config afterwards.

    Example: servobus set-id gimbal 37 38 --save
    """
    _change(options, bus, lambda rig: rig.set_id(bus, old, new, save=save))


@click.command("set-baud")
@click.argument("bus")
@click.argument("servo_id", metavar="ID", type=ID)
@click.argument("baudrate", type=click.IntRange(min=1))
@click.option("--save", is_flag=True, help=SAVE)
@servo_options
def set_baud(options: Options, bus: str, servo_id: int, baudrate: int, save: bool) -> None:
    """Change the baud rate of a servo. The servo with this ID on BUS, a bus of the config, gets BAUDRATE, in bits/s.

    Refused while a servo of the bus is enabled. When all servos of the bus have the new rate, write it into the config.

    Example: servobus set-baud gimbal 37 115200 --save
    """
    _change(options, bus, lambda rig: rig.set_baudrate(bus, servo_id, baudrate, save=save))


@click.command()
@click.argument("bus")
@click.argument("servo_id", metavar="ID", type=ID)
@click.argument("name")
@click.argument("value", required=False, type=int)
@servo_options
def command(options: Options, bus: str, servo_id: int, name: str, value: int | None) -> None:
    """Send a maintenance command to a servo or a hand. The device with this ID on BUS, a bus of the config, gets it once.

    The protocol defines the commands (restart, save, zero_force, ...); an unknown NAME lists them. A command is never repeated,
    even if no reply comes. Refused while a servo of the bus is enabled.

    Example: servobus command hand 2 zero_force
    """
    _change(options, bus, lambda rig: rig.command(bus, servo_id, name, value))


def _change(options: Options, bus: str, verb: Callable[[servobus.Rig], Awaitable[Change | tuple[str, ...]]]) -> None:
    def check(config: Any) -> None:
        if bus not in config.buses:
            raise UnknownName(f"no bus {bus!r}: there are {', '.join(config.buses)}")

    async def action(context: RigContext) -> None:
        result = await verb(context.rig)
        if options.as_json:
            emit(result)
        else:
            echo("\n".join(_lines(result)))

    on_rig(options, action, only=[bus], before=check)


def _lines(result: Change | tuple[str, ...]) -> tuple[str, ...]:
    if isinstance(result, Change):
        return (str(result) if result.pending_reboot else f"{result.what} {result.value} is in effect", *result.notes)
    return result or ("done",)
