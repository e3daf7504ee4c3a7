"""install-service: the daemon as a service of the system."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import click

from servobus.cli.output import echo
from servobus.daemon import units


@click.command()
@click.argument("config", metavar="CONFIG", default=units.CONFIG)
@click.option("--write", "writing", is_flag=True, help="Write the files instead of printing them.")
@click.option(
    "--root", default="/", type=click.Path(path_type=Path, file_okay=False), help="Folder to write the files below. Default: /."
)
@click.option("--force", is_flag=True, help="Replace files that have other contents.")
def install_service(config: str, writing: bool, root: Path, force: bool) -> None:
    """Print or write the files of a system service. They run `servobus run CONFIG`: a systemd unit, udev rules and a user.

    CONFIG is the path where the service finds its config, /etc/servobus/servobus.yaml if omitted. An existing CONFIG is checked,
    and the unit opens the network only if that config needs it. Starts nothing.

    Example: servobus install-service /etc/servobus/servobus.yaml --write
    """
    path = Path(config).absolute()
    texts = units.files(_command(), str(path), network=_needs_network(path))
    if not writing:
        for file, text in texts.items():
            echo(f"# {file}\n{text}")
        return
    for written in units.write(texts, root, force=force):
        echo(f"wrote {written}")
    echo("then, as root:\n  " + "\n  ".join(units.AFTER))


def _needs_network(path: Path) -> bool:
    if not path.exists():
        echo(f"{path} does not exist yet: the service needs it to start", err=True)
        return False
    from servobus.config.loader import load_config

    config = load_config(path)
    return config.door.tcp is not None or any("://" in bus.port for bus in config.buses.values())


def _command() -> str:
    beside = Path(sys.executable).with_name("servobus")
    return str(beside) if beside.exists() else shutil.which("servobus") or f"{sys.executable} -m servobus"
