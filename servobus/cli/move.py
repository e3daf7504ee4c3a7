"""Commands that move or stop: move, enable, disable, stop, clear.

A command without a daemon opens the ports. When it ends, it does the `on_exit` of each servo that it enabled.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import click

import servobus
from servobus.cli.options import Number, Options, RigContext, on_rig, parse_pairs, servo_options
from servobus.cli.output import echo, emit, report
from servobus.errors import LimitError, NotSupported

TARGET = "NAME=POSITION"
THEN = {
    "stays": "stays enabled",
    "hold": "holds (on_exit)",
    "limp": "goes limp (on_exit)",
    "park": "parks, then goes limp (on_exit)",
}
"""What happens to an enabled servo when the command ends, as a table shows it."""

HELD = "disabled, and may still hold: it does not tell its torque"

Data = dict[str, Any]
Rows = list[tuple[object, ...]]
"""The result of a command, for machines and for people. It is printed when the servos are left: until then it may still fail."""


@click.command()
@click.argument("targets", metavar=f"{TARGET}...", nargs=-1, required=True)
@click.option("--speed", type=float, metavar="UNIT/S", help="Speed on the way. Default: the servo's `speed` of the config.")
@click.option("--duration", type=float, metavar="SECONDS", help="Time for the way, instead of a speed.")
@click.option("--together", is_flag=True, help="All servos of a bus begin at the same moment, or none does.")
@click.option("--confirm", is_flag=True, help="Every servo acknowledges its goal before any of them moves.")
@click.option("--timeout", default=10.0, show_default=True, type=Number(min=0), metavar="SECONDS", help="Time to arrive.")
@servo_options
def move(
    options: Options,
    targets: tuple[str, ...],
    speed: float | None,
    duration: float | None,
    together: bool,
    confirm: bool,
    timeout: float,
) -> None:
    """Move servos and wait until they arrive.

    Positions are in each servo's unit (degrees if the config names none). A goal outside a limit is refused before a port is
    opened. Through a daemon the servos must be enabled, and stay enabled. Without a daemon they are enabled first, and their
    `on_exit` is done at the end. Ctrl-C stops the motion: by `on_lost_client` through a daemon, else by `on_exit`.

    Example: servobus move shoulder=10 elbow=-20 --speed 30
    """
    positions = {name: _position(name, text) for name, text in parse_pairs(targets, TARGET, "elbow=30").items()}

    def check(config: Any) -> None:
        from servobus.cli.checks import check_goals
        from servobus.rig.interface import full_name

        check_goals(config, _by_full_name(positions, lambda name: full_name(config.names, name)), speed, duration)

    async def action(context: RigContext) -> tuple[Data, Rows]:
        rig = context.rig
        goals = _by_full_name(positions, rig.full_name)
        if not context.has_daemon:
            await _enable(rig, goals, speed, duration)
        await rig.move(goals, together=together, confirm=confirm, speed=speed, duration=duration)
        states = await rig.settle(*goals, timeout=timeout)
        data = {name: {"position": state.position, "then": context.then(name)} for name, state in states.items()}
        return data, [(name, state.position, THEN[context.then(name)]) for name, state in states.items()]

    data, rows = on_rig(options, action, list(positions), before=check, energises=True)
    report(options.as_json, data, ("servo", "position", "then"), rows)


async def _enable(rig: servobus.Rig, goals: Mapping[str, float], speed: float | None, duration: float | None) -> None:
    """Enable servos once each of them has told that it can take its goal."""
    from servobus.cli.checks import check_servos

    await check_servos(rig, goals, speed, duration)
    await rig.enable(*goals)


def _position(target: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise LimitError(f"{target}={text}: {text!r} is not a number: nothing was sent") from None


def _by_full_name(positions: Mapping[str, float], full_name: Callable[[str], str]) -> dict[str, float]:
    """The same positions by full name. Raises BadParameter where two names mean one servo."""
    goals: dict[str, float] = {}
    for name, position in positions.items():
        full = full_name(name)
        if full in goals:
            raise click.BadParameter(f"{full} is named twice: give each servo one position", param_hint=TARGET)
        goals[full] = position
    return goals


@click.command()
@click.argument("names", metavar="[NAME]...", nargs=-1)
@servo_options
def enable(options: Options, names: tuple[str, ...]) -> None:
    """Switch torque on; each servo holds its present position. Without a NAME all servos are enabled.

    A daemon keeps them enabled. Without a daemon their `on_exit` is done at once: with `hold` they stay energised.

    Example: servobus enable elbow
    """

    async def action(context: RigContext) -> tuple[Data, Rows]:
        await context.rig.enable(*names)
        enabled = context.rig.full_names(names)
        data = {name: {"enabled": True, "then": context.then(name)} for name in enabled}
        return data, [(name, "enabled", THEN[context.then(name)]) for name in enabled]

    data, rows = on_rig(options, action, names, energises=True)
    report(options.as_json, data, ("servo", "state", "then"), rows)


@click.command()
@click.argument("names", metavar="[NAME]...", nargs=-1)
@servo_options
def disable(options: Options, names: tuple[str, ...]) -> None:
    """Switch torque off, and confirm it by reading back. Without a NAME all servos are disabled.

    A servo that has no torque command (KST, a finger) goes on to hold where it is.

    Example: servobus disable elbow
    """

    async def action(context: RigContext) -> None:
        await context.rig.disable(*names)
        states = context.rig.snapshot()
        energised = {name: states[name].energised for name in context.rig.full_names(names)}
        data = {name: {"enabled": False, "energised": energised[name]} for name in energised}
        rows = [(name, "limp" if energised[name] is False else HELD) for name in energised]
        report(options.as_json, data, ("servo", "state"), rows)

    on_rig(options, action, names, energises=True)


@click.command()
@servo_options
def stop(options: Options) -> int:
    """E-stop all servos of all buses. Each servo does its `on_estop`; a limp servo stays limp.

    Prints what each servo confirmed. A daemon latches the e-stop until `servobus clear`. A bus whose port cannot be opened does
    not keep the others from being stopped. The exit status is 1 unless every servo confirmed.

    Example: servobus stop
    """

    async def action(context: RigContext) -> int:
        reports = await context.rig.stop()
        if not context.has_daemon:
            echo("not latched: no daemon runs, so the next command may move again", err=True)
        rows = [(name, each.action, each.written, each.confirmed, each.detail or None) for name, each in reports.items()]
        report(options.as_json, reports, ("servo", "action", "written", "confirmed", "detail"), rows)
        return 0 if all(each.confirmed for each in reports.values()) else 1

    return on_rig(options, action, degraded=True)


@click.command()
@servo_options
def clear(options: Options) -> None:
    """Release the e-stop of a daemon. Moves nothing.

    Names the servos that have not confirmed their stop. The daemon goes on to stop them as soon as they answer.

    Example: servobus clear
    """

    def refuse(config: Any) -> None:
        buses = ", ".join(config.buses)
        raise NotSupported(f"no e-stop is latched on {buses}: no daemon runs (`servobus run`), and only a daemon latches one")

    async def action(context: RigContext) -> None:
        latched = context.rig.stopped
        owed = await context.rig.clear()
        if options.as_json:
            emit({"released": latched, "owed": owed})
            return
        echo("the e-stop is released: enable and move again" if latched else "no e-stop was latched")
        if owed:
            echo(f"still owed: the stop of {', '.join(owed)}, which is repeated until it is confirmed", err=True)

    on_rig(options, action, before=refuse)
