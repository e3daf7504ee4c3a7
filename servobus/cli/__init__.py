"""The command line: the table of commands, and the exit status that an error ends with.

A command's module is imported when the command is used. The table holds the short help beside it, so that `servobus --help` and
completion import no command at all.
"""

from __future__ import annotations

import difflib
import importlib
import sys
from typing import Any, NamedTuple

import click

import servobus
from servobus.cli.output import accept_any_encoding, echo
from servobus.errors import ServobusError


class CommandInfo(NamedTuple):
    """One line of the table of commands."""

    module: str
    """The module beside this one that has the command."""
    help: str
    """The first sentence of the command's docstring; a test keeps the two equal."""


COMMANDS = {
    "run": CommandInfo("service", "Own the ports of CONFIG as a daemon, and serve other programs."),
    "sim": CommandInfo("service", "Serve the servos of CONFIG, simulated, as serial ports."),
    "demo": CommandInfo("service", "Stream goals to 20 simulated servos on four lines."),
    "check": CommandInfo("offline", "Validate a config and print the load of each line."),
    "schema": CommandInfo("offline", "Print the JSON Schema of configs, for editors."),
    "decode": CommandInfo("offline", "Explain the frames in some bytes."),
    "ports": CommandInfo("offline", "List the serial ports of this machine."),
    "scan": CommandInfo("scan", "Search a line for servos."),
    "ping": CommandInfo("registers", "Ask servos whether they answer."),
    "read": CommandInfo("registers", "Read the state of servos, or one register of a servo."),
    "write": CommandInfo("registers", "Write registers of a servo, and read them back."),
    "monitor": CommandInfo("monitor", "Show the state of servos, live."),
    "stats": CommandInfo("monitor", "Print the counters and times of each line."),
    "move": CommandInfo("move", "Move servos and wait until they arrive."),
    "enable": CommandInfo("move", "Switch torque on; each servo holds its present position."),
    "disable": CommandInfo("move", "Switch torque off, and confirm it by reading back."),
    "stop": CommandInfo("move", "E-stop all servos of all buses."),
    "clear": CommandInfo("move", "Release the e-stop of a daemon."),
    "set-id": CommandInfo("maintenance", "Change the id of a servo."),
    "set-baud": CommandInfo("maintenance", "Change the baud rate of a servo."),
    "command": CommandInfo("maintenance", "Send a maintenance command to a servo or a hand."),
    "install-service": CommandInfo("install", "Print or write the files of a system service."),
}
INTERRUPTED = 130


class Commands(click.Group):
    """Imports a command when it is used."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        module = importlib.import_module(f"servobus.cli.{COMMANDS[cmd_name].module}")
        command: click.Command = getattr(module, cmd_name.replace("-", "_"))
        return command

    def resolve_command(self, ctx: click.Context, args: list[str]) -> tuple[str | None, click.Command | None, list[str]]:
        name = args[0]
        if name not in COMMANDS and not name.startswith("-") and not ctx.resilient_parsing:
            near = difflib.get_close_matches(name, COMMANDS, n=1)
            hint = f"did you mean {near[0]}?" if near else "`servobus --help` lists the commands"
            ctx.fail(f"No such command {name!r}; {hint}")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, info.help) for name, info in COMMANDS.items()])


def _print_version(ctx: click.Context, _: click.Parameter, wanted: bool) -> None:
    if wanted and not ctx.resilient_parsing:
        echo(servobus.__version__)
        ctx.exit()


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--version", is_flag=True, is_eager=True, expose_value=False, callback=_print_version, help="Print the version.")
def cli() -> None:
    """servobus owns a robot's serial lines and gives many callers safe access to many servos.

    A command on servos talks to the running daemon. Without one it opens the ports of a config itself: -c CONFIG, else
    SERVOBUS_CONFIG, else ./servobus.yaml. Positions are in each servo's unit (degrees if the config names none), speeds in
    unit/s, times in seconds.

    \b
    Exit status:
      0    done
      1    a port is missing, busy or denied, a device failed, a lease is
           held, the e-stop is latched, or a part of the work failed
      2    the usage, the config or a name is wrong, or a value is outside
           a limit; a line that must carry more than 100 %
      130  interrupted by Ctrl-C

    Example: servobus read -c config/sim.yaml
    """


def main(arguments: list[str] | None = None) -> None:
    """Run a command and end the process with its exit status."""
    sys.exit(status_of(arguments))


def status_of(arguments: list[str] | None = None) -> int:
    """Run a command and return its exit status. An error becomes one message on standard error."""
    accept_any_encoding()
    try:
        result: Any = cli.main(arguments, prog_name="servobus", standalone_mode=False)
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except ServobusError as error:
        echo(f"servobus: {error}", err=True)
        return error.exit_status
    except OSError as error:
        echo(f"servobus: {error}", err=True)
        return ServobusError.exit_status
    except (KeyboardInterrupt, click.Abort):
        return INTERRUPTED
    return result if isinstance(result, int) else 0
