"""The command line. Each command is imported when it is used, so that `--help` and completion are fast.

What every command shares (config, output, errors, exit status) stands in `common`.
"""

from __future__ import annotations

import importlib
import sys
from importlib.metadata import version
from typing import Any

import click

from servobus.errors import ServobusError

COMMANDS = {
    "run": "service",
    "sim": "service",
    "demo": "demo",
    "check": "offline",
    "schema": "offline",
    "decode": "offline",
    "ports": "offline",
    "scan": "scan",
    "ping": "registers",
    "read": "registers",
    "write": "registers",
    "monitor": "monitor",
    "stats": "monitor",
    "move": "move",
    "enable": "move",
    "disable": "move",
    "stop": "move",
    "clear": "move",
    "set-id": "maintenance",
    "set-baud": "maintenance",
    "command": "maintenance",
    "install-service": "install",
}
"""Command -> the module beside this one that has it."""
INTERRUPTED = 130


class Commands(click.Group):
    """Imports a command when it is asked for."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        module = importlib.import_module(f"servobus.cli.{COMMANDS[cmd_name]}")
        command: click.Command = getattr(module, cmd_name.replace("-", "_"))
        return command


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(version("servobus"), message="%(version)s")
def cli() -> None:
    """servobus owns a robot's serial lines and gives many callers safe access to many servos.

    Commands on servos take their config from -c CONFIG, else SERVOBUS_CONFIG, else ./servobus.yaml. Positions are in each servo's
    unit (degrees if it names none), speeds in unit/s, times in seconds.

    Exit status: 0 done; 1 port or device failed; 2 usage, config, limit or unknown name; 130 Ctrl-C.
    """


def main(arguments: list[str] | None = None) -> None:
    """Run a command and end with its exit status."""
    sys.exit(status_of(arguments))


def status_of(arguments: list[str] | None = None) -> int:
    """Run a command; what goes wrong is one message on standard error."""
    try:
        result: Any = cli.main(arguments, prog_name="servobus", standalone_mode=False)
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except ServobusError as error:
        click.echo(f"servobus: {error}", err=True)
        return error.exit_status
    except OSError as error:
        click.echo(f"servobus: {error}", err=True)
        return ServobusError.exit_status
    except (KeyboardInterrupt, click.Abort):
        return INTERRUPTED
    return result if isinstance(result, int) else 0
