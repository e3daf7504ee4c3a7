"""Commands that give servos their ids and rates, or tell them what is told once: set-id, set-baud, command."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

import click

from servobus.cli.output import emit, logs, run
from servobus.cli.rig_context import Options, opened, servo_options
from servobus.config.loader import Config
from servobus.errors import UnknownName
from servobus.rig.interface import Rig
from servobus.values import Change

Id = click.IntRange(0, 255)


@click.command("set-id")
@click.argument("bus")
@click.argument("old", type=Id)
@click.argument("new", type=Id)
@click.option("--save", is_flag=True, help="Write it to the servo's flash; without, a restart forgets it.")
@servo_options
def set_id(options: Options, bus: str, old: int, new: int, save: bool) -> int:
    """Give the servo with id OLD on a bus of the config the id NEW.

    Nothing on the bus is moved or enabled. Refused when two servos seem to answer at OLD, or one at NEW. Then change the config.

    Example: servobus set-id gimbal 37 38 --save
    """
    return _change(options, bus, lambda rig: rig.set_id(bus, old, new, save=save))


@click.command("set-baud")
@click.argument("bus")
@click.argument("servo_id", metavar="ID", type=Id)
@click.argument("baudrate", type=click.IntRange(min=1))
@click.option("--save", is_flag=True, help="Write it to the servo's flash; without, a restart forgets it.")
@servo_options
def set_baud(options: Options, bus: str, servo_id: int, baudrate: int, save: bool) -> int:
    """Give the servo with this id on a bus of the config another baud rate. Then change the config, when all servos have it.

    Example: servobus set-baud gimbal 37 115200 --save
    """
    return _change(options, bus, lambda rig: rig.set_baudrate(bus, servo_id, baudrate, save=save))


@click.command()
@click.argument("bus")
@click.argument("servo_id", metavar="ID", type=Id)
@click.argument("name")
@click.argument("value", required=False, type=int)
@servo_options
def command(options: Options, bus: str, servo_id: int, name: str, value: int | None) -> int:
    """Tell the servo or hand with this id on a bus of the config what is told once: restart, save, zero_force, ...

    Which commands there are depends on the protocol: a name that is none lists them. Never repeated, even if nobody answers.
    Nothing on the bus may be enabled.

    Example: servobus command hand 2 zero_force
    """

    async def verb(rig: Rig) -> tuple[str, ...]:
        return await rig.command(bus, servo_id, name, value)

    return _change(options, bus, verb)


def _change(options: Options, bus: str, verb: Callable[[Rig], Awaitable[Change | tuple[str, ...]]]) -> int:
    logs()

    def refuse(config: Config) -> None:
        if bus not in config.buses:
            raise UnknownName(f"no bus {bus!r}: there are {', '.join(config.buses)}")

    async def main() -> int:
        async with opened(options, only=[bus], before=refuse) as rig:
            done = await verb(rig)
            if options.as_json:
                emit(done)
            else:
                click.echo("\n".join(_words(done)))
            return 0

    return run(main)


def _words(done: Change | tuple[str, ...]) -> tuple[str, ...]:
    if isinstance(done, Change):
        return (str(done) if done.pending_reboot else f"{done.what} {done.value} is in effect", *done.notes)
    return done or ("done",)
