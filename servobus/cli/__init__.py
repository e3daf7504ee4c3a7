"""The command line: the table of commands, and the exit status that an error ends with.

A command's module is imported when the command is used. The table holds the short help beside it, so that `servobus --help` and
completion import no command at all.
"""

from __future__ import annotations

import difflib
import importlib
import signal
import sys
from typing import Any

import click

from servobus.cli.ending import INTERRUPTED, TERMINATED, Ending
from servobus.cli.output import accept_any_encoding, echo
from servobus.errors import ServobusError

COMMANDS = {
    "run": ("service", "Own the ports of CONFIG as a daemon, and serve other programs."),
    "sim": ("service", "Serve the servos of CONFIG, simulated, as serial ports."),
    "demo": ("service", "Stream goals to 20 simulated servos on four lines."),
    "check": ("offline", "Validate a config and print the load of each line."),
    "schema": ("offline", "Print the JSON Schema of configs, for editors."),
    "decode": ("offline", "Explain the frames in some bytes."),
    "ports": ("offline", "List the serial ports of this machine."),
    "scan": ("scan", "Search a line for servos."),
    "ping": ("registers", "Ask servos whether they answer."),
    "read": ("registers", "Read the state of servos, or one register of a servo."),
    "write": ("registers", "Write registers of a servo, and read them back."),
    "monitor": ("monitor", "Show the state of servos, live."),
    "stats": ("monitor", "Print the counters and times of each line."),
    "move": ("move", "Move servos and wait until they arrive."),
    "enable": ("move", "Switch torque on; each servo holds its present position."),
    "disable": ("move", "Switch torque off, and confirm it by reading back."),
    "stop": ("move", "E-stop all servos of all buses."),
    "clear": ("move", "Release the e-stop of a daemon."),
    "set-id": ("maintenance", "Change the id of a servo."),
    "set-baud": ("maintenance", "Change the baud rate of a servo."),
    "command": ("maintenance", "Send a maintenance command to a servo or a hand."),
    "install-service": ("install", "Print or write the files of a system service."),
}
"""Command -> the module beside this one that has it, and the first sentence of its docstring (a test keeps the two equal)."""


class Commands(click.Group):
    """Imports a command when it is used."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        module = importlib.import_module(f"servobus.cli.{COMMANDS[cmd_name][0]}")
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
            formatter.write_dl([(name, text) for name, (_, text) in COMMANDS.items()])


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="servobus", message="%(version)s")
def cli() -> None:
    """servobus owns a robot's serial lines and gives many callers safe access to many servos.

    A command on servos talks to the daemon that --socket or SERVOBUS_SOCKET names, else to the one at the usual place. Where
    there is none it opens the ports of a config itself: -c CONFIG, else SERVOBUS_CONFIG, else ./servobus.yaml. It never does so
    because a daemon that was named does not answer, or has died. Positions are in each servo's unit (degrees if the config names
    none), speeds in unit/s, times in seconds.

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
    status = status_of(arguments)
    if status in (INTERRUPTED, TERMINATED):  # all is done and said, and one more signal must not change the status
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)
    sys.exit(status)


def status_of(arguments: list[str] | None = None) -> int:
    """Run a command and return its exit status. An error becomes one message on standard error, and with --json one document."""
    accept_any_encoding()
    ending = Ending(as_json="--json" in (sys.argv[1:] if arguments is None else arguments))
    try:
        result: Any = cli.main(arguments, prog_name="servobus", standalone_mode=False, obj=ending)
    except click.ClickException as error:
        error.show()
        ending.failed(error, error.format_message())
        return error.exit_code
    except (ServobusError, OSError) as error:
        echo(f"servobus: {error}", err=True)
        ending.failed(error, str(error))
        return error.exit_status if isinstance(error, ServobusError) else ServobusError.exit_status
    except (KeyboardInterrupt, SystemExit, click.Abort) as error:
        ending.failed(error)
        return error.code if isinstance(error, SystemExit) and isinstance(error.code, int) else INTERRUPTED
    return result if isinstance(result, int) else 0
