"""Commands that move or stop: move, enable, disable, stop, clear. Through the daemon where one runs; else each opens the port
itself and leaves it again, and what it enabled is then left as the servo's `on_exit` says.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import click

from servobus.bus.limits import check_goal
from servobus.cli.output import Number, echo_table, emit, logs, run
from servobus.cli.rig_context import Options, opened, servo_options
from servobus.config.loader import Config
from servobus.errors import LimitError, NotSupported, ServobusError
from servobus.protocols.registry import PROTOCOLS
from servobus.rig.interface import Rig, full_name
from servobus.rig.local import LocalRig
from servobus.values import Goal, ServoGoal

NOT_LATCHED = "not latched: no daemon runs, so the next command may move again"
THEN = {
    "stays": "stays enabled",
    "hold": "holds (on_exit)",
    "limp": "goes limp (on_exit)",
    "park": "parks, then goes limp (on_exit)",
}
"""What an exit policy leaves, in words."""


@click.command()
@click.argument("targets", metavar="NAME=POSITION...", nargs=-1, required=True)
@click.option("--speed", type=float, help="Unit/s on the way.")
@click.option("--duration", type=float, help="Seconds the way shall take, instead of a speed.")
@click.option("--together", is_flag=True, help="All begin at the same moment, or none does.")
@click.option("--confirm", is_flag=True, help="Every servo acknowledges before any moves.")
@click.option("--timeout", default=10.0, show_default=True, type=Number(min=0), help="Seconds to arrive within.")
@servo_options
def move(
    options: Options,
    targets: tuple[str, ...],
    speed: float | None,
    duration: float | None,
    together: bool,
    confirm: bool,
    timeout: float,
) -> int:
    """Move servos and wait until they stand. Through a daemon they must be enabled, and stay so.

    Without a daemon they are enabled first, and left as their `on_exit` says at the end. Positions in each servo's unit (degrees
    if it names none). What a limit forbids is refused before a port is opened. Ctrl-C stops the motion: by `on_lost_client`
    through a daemon, else by `on_exit`.

    Example: servobus move shoulder=10 elbow=-20 --speed 30
    """
    logs()
    said = _targets(targets)

    def refuse(config: Config) -> None:
        _refuse(config, _full(said, lambda name: full_name(config.names, name)), speed, duration)

    async def main() -> int:
        async with opened(options, list(said), before=refuse) as rig:
            goals = _full(said, rig.full_name)
            if isinstance(rig, LocalRig):
                await rig.enable(*goals)
            await rig.move(goals, together=together, confirm=confirm, speed=speed, duration=duration)
            states = await rig.settle(*goals, timeout=timeout)
            if options.as_json:
                emit({name: {"position": state.position, "then": _then(rig, name)} for name, state in states.items()})
            else:
                rows = [(name, state.position, _words(rig, name)) for name, state in states.items()]
                echo_table(None, ("servo", "position", "then"), rows)
            return 0

    return run(main)


def _targets(texts: Iterable[str]) -> dict[str, float]:
    """What was said, name by name."""
    said: dict[str, float] = {}
    for text in texts:
        name, position = _target(text)
        if name in said:
            raise click.BadParameter(f"{name} is named twice: give each servo one position", param_hint="NAME=POSITION")
        said[name] = position
    return said


def _full(said: Mapping[str, float], full: Callable[[str], str]) -> dict[str, float]:
    """By full name."""
    goals: dict[str, float] = {}
    for name, position in said.items():
        if full(name) in goals:
            raise click.BadParameter(f"{full(name)} is named twice: give each servo one position", param_hint="NAME=POSITION")
        goals[full(name)] = position
    return goals


def _refuse(config: Config, goals: Mapping[str, float], speed: float | None, duration: float | None) -> None:
    """What no servo of that kind may do, while nothing is energised yet: LimitError, UnknownName, NotSupported."""
    for name, position in goals.items():
        bus, servo = config.names[name]
        options = config.buses[bus]
        try:
            goal = check_goal(servo, Goal("position", position, speed, duration), options.servos[servo], None)
            PROTOCOLS[options.protocol].driver(options, config.models[bus]).check_goal(ServoGoal(servo, goal))
        except ServobusError as error:
            raise error.at(bus=bus) from None


def _target(text: str) -> tuple[str, float]:
    name, equals, position = text.rpartition("=")
    if not (name and equals):
        raise click.BadParameter(f"{text!r}: write NAME=POSITION", param_hint="NAME=POSITION")
    try:
        return name, float(position)
    except ValueError:
        raise LimitError(f"{text}: {position!r} is no number: nothing was sent") from None


def _then(rig: Rig, name: str) -> str:
    """What becomes of it when this command ends: its `on_exit`, or nothing, where a daemon keeps it."""
    if not isinstance(rig, LocalRig):
        return "stays"
    bus, servo = rig.config.names[name]
    return rig.config.buses[bus].servos[servo].on_exit


def _words(rig: Rig, name: str) -> str:
    return THEN[_then(rig, name)]


@click.command()
@click.argument("names", metavar="[NAME]...", nargs=-1)
@servo_options
def enable(options: Options, names: tuple[str, ...]) -> int:
    """Energise servos where they stand: the present position becomes the goal, then torque goes on. All if none is named.

    A daemon keeps them so. Without one they are at once left as their `on_exit` says: with hold they stay energised.

    Example: servobus enable elbow
    """
    logs()

    async def main() -> int:
        async with opened(options, names) as rig:
            await rig.enable(*names)
            done = rig.full_names(names)
            if options.as_json:
                emit({name: {"enabled": True, "then": _then(rig, name)} for name in done})
            else:
                echo_table(None, ("servo", "state", "then"), [(name, "enabled", _words(rig, name)) for name in done])
            return 0

    return run(main)


@click.command()
@click.argument("names", metavar="[NAME]...", nargs=-1)
@servo_options
def disable(options: Options, names: tuple[str, ...]) -> int:
    """Switch torque off, confirmed by reading back. All servos if none is named.

    Example: servobus disable elbow
    """
    logs()

    async def main() -> int:
        async with opened(options, names) as rig:
            await rig.disable(*names)
            done = rig.full_names(names)
            if options.as_json:
                emit({name: {"enabled": False} for name in done})
            else:
                echo_table(None, ("servo", "state"), [(name, "limp") for name in done])
            return 0

    return run(main)


@click.command()
@servo_options
def stop(options: Options) -> int:
    """E-stop: every servo of every bus stops as its `on_estop` says; what was limp stays limp. Tells what each confirmed.

    A daemon latches it until `servobus clear`. A bus whose port cannot be opened does not keep the others from being stopped.
    Status 1 unless all confirmed.

    Example: servobus stop
    """
    logs()

    async def main() -> int:
        async with opened(options, degraded=True) as rig:
            reports = await rig.stop()
            if isinstance(rig, LocalRig):
                click.echo(NOT_LATCHED, err=True)
            if options.as_json:
                emit(reports)
            else:
                rows = [
                    (name, report.action, report.written, report.confirmed, report.detail or None)
                    for name, report in reports.items()
                ]
                echo_table(None, ("servo", "action", "written", "confirmed", "detail"), rows)
            return 0 if all(report.confirmed for report in reports.values()) else 1

    return run(main)


@click.command()
@servo_options
def clear(options: Options) -> int:
    """Release the e-stop that a daemon has latched. Moves nothing.

    Example: servobus clear
    """
    logs()

    def refuse(config: Config) -> None:
        buses = ", ".join(config.buses)
        raise NotSupported(f"no e-stop is latched on {buses}: no daemon runs (`servobus run`), and only a daemon latches one")

    async def main() -> int:
        async with opened(options, before=refuse) as rig:
            was = rig.stopped
            await rig.clear()
            if options.as_json:
                emit({"released": was})
            else:
                click.echo("the e-stop is released: enable and move again" if was else "no e-stop was latched")
            return 0

    return run(main)
