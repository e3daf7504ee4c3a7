"""What every command on servos shares: its options, and how it gets a rig.

Imports nothing but click, so that `--help` is fast. `rig_context`, which opens a rig, is imported when a command runs.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Awaitable, Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import click

import servobus
from servobus.rpc.socket_path import VARIABLE

F = TypeVar("F", bound=Callable[..., Any])
R = TypeVar("R")


class Number(click.FloatRange):
    """A finite number within a range; click's own range lets nan and inf pass."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        number: float = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number.", param, ctx)
        return number


@dataclass(frozen=True)
class Options:
    """The options of every command on servos."""

    config: str | None
    as_json: bool
    trace: bool
    dry_run: bool
    direct: bool = False
    socket: str | None = None
    """Address of the daemon that was named, by --socket or SERVOBUS_SOCKET."""
    given: bool = False
    """The config was given by -c, not by the environment."""
    parsed: Any = None  # a Config to use instead of a file


@dataclass(frozen=True, slots=True)
class BusFacts:
    """What a command may know of a bus, in this process or in a daemon."""

    protocol: str
    port: str
    polled: bool  # the bus polls its servos, so their last states are fresh


@dataclass(frozen=True, slots=True)
class RigContext:
    """The rig of a command, and who keeps it."""

    rig: servobus.Rig
    buses: Callable[[], Awaitable[Mapping[str, BusFacts]]]
    on_exit: Mapping[str, str] | None = None
    """Full name -> the servo's `on_exit`, which is done when the command ends; None: a daemon keeps the servos as they are."""

    @property
    def has_daemon(self) -> bool:
        return self.on_exit is None

    def then(self, name: str) -> str:
        """What happens to an enabled servo when the command ends: stays, hold, limp or park."""
        return "stays" if self.on_exit is None else self.on_exit[name]


def parse_pairs(texts: Iterable[str], hint: str, example: str) -> dict[str, str]:
    """Split each NAME=VALUE. Raises BadParameter for another form and for a name that is given twice."""
    pairs: dict[str, str] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (name and equals and value):
            raise click.BadParameter(f"{text!r}: write {hint}, for example {example}", param_hint=hint)
        if name in pairs:
            raise click.BadParameter(f"{name} is named twice: give each name one value", param_hint=hint)
        pairs[name] = value
    return pairs


json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON document on standard output, for machines.")


def servo_options(command: F) -> F:
    """Adds the options of every command on servos, and passes them on as one `options`."""

    @click.option(
        "-c", "--config", envvar="SERVOBUS_CONFIG", metavar="CONFIG", help="Bus config (YAML). Default: ./servobus.yaml."
    )
    @json_option
    @click.option("--trace", is_flag=True, help="Print every frame, sent and received, on standard error.")
    @click.option("--dry-run", is_flag=True, help="Open no port: use simulated servos, and print what would be sent.")
    @click.option("--direct", is_flag=True, help="Open the ports in this process even if a daemon runs, or was named.")
    @click.option(
        "--socket",
        envvar=VARIABLE,
        metavar="PATH|tcp://HOST:PORT",
        help="The daemon to use. If it does not answer, the command fails. Default: a daemon at the usual place.",
    )
    @functools.wraps(command)
    def wrapper(
        config: str | None, as_json: bool, trace: bool, dry_run: bool, direct: bool, socket: str | None, **arguments: Any
    ) -> Any:
        if direct and _given("socket"):
            raise click.UsageError("--socket names a daemon, and --direct asks for none: give one of them")
        return command(options=Options(config, as_json, trace, dry_run, direct, socket, _given("config")), **arguments)

    return wrapper  # type: ignore[return-value]


def _given(parameter: str) -> bool:
    """Whether a person wrote the option on this command line."""
    return click.get_current_context().get_parameter_source(parameter) is click.core.ParameterSource.COMMANDLINE


def on_rig(
    options: Options,
    action: Callable[[RigContext], Awaitable[R]],
    names: Collection[str] = (),
    *,
    only: Collection[str] = (),
    degraded: bool = False,
    before: Callable[[Any], object] | None = None,
    energises: bool = False,
) -> R:
    """Run the action of a command on a rig, in an event loop; the arguments are those of `rig_context.open_context`."""
    from servobus.cli.event_loop import run
    from servobus.cli.logs import set_up_logs
    from servobus.cli.rig_context import open_context

    async def main() -> R:
        async with open_context(options, names, only=only, degraded=degraded, before=before, energises=energises) as context:
            return await action(context)

    set_up_logs()
    return run(main)
