"""install-service: the daemon as a service of the system."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import click

from servobus.config.loader import load_config
from servobus.daemon import units


@click.command()
@click.argument("config", metavar="CONFIG", default=units.CONFIG)
@click.option("--write", "writing", is_flag=True, help="Write the files instead of printing them.")
@click.option("--root", default="/", type=click.Path(path_type=Path, file_okay=False), help="Write them below this folder.")
@click.option("--force", is_flag=True, help="Replace files that hold something else.")
def install_service(config: str, writing: bool, root: Path, force: bool) -> None:
    """Print the files that make `servobus run CONFIG` a service: systemd unit, udev rules, and its user.

    CONFIG is where the service will find it, /etc/servobus/servobus.yaml if omitted; when it exists it is checked, and the unit
    opens the network only if the config needs it. Nothing is started.

    Example: servobus install-service /etc/servobus/servobus.yaml --write
    """
    path = Path(config).absolute()
    network = False
    if path.exists():
        setup = load_config(path)
        network = setup.door.tcp is not None or any("://" in bus.port for bus in setup.buses.values())
    else:
        click.echo(f"{path} is not there yet: the service needs it to start", err=True)
    texts = units.files(_command(), str(path), network=network)
    if not writing:
        for place, text in texts.items():
            click.echo(f"# {place}\n{text}")
        return
    for written in units.write(texts, root, force=force):
        click.echo(f"wrote {written}")
    click.echo("then, as root:\n  " + "\n  ".join(units.AFTER))


def _command() -> str:
    """The servobus that is running now."""
    beside = Path(sys.executable).with_name("servobus")
    return str(beside) if beside.exists() else shutil.which("servobus") or f"{sys.executable} -m servobus"
