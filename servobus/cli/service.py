"""Commands that stay: run, sim."""

from __future__ import annotations

import logging
import signal
import stat
from pathlib import Path

import anyio
import click

from servobus.cli.output import Number, logs
from servobus.cli.output import run as run_loop
from servobus.config.loader import load_config
from servobus.daemon.main import serve_rig
from servobus.errors import ConfigError
from servobus.rig.logs import EventLogger
from servobus.rpc.socket_path import socket_path
from servobus.simulation.serve import serve

log = EventLogger("servobus.cli")


@click.command()
@click.argument("config", metavar="CONFIG")
@click.option("--log-every", default=10.0, show_default=True, type=Number(min=0.1), help="Seconds between two lines of state.")
def run(config: str, log_every: float) -> None:
    """Own the ports of CONFIG until SIGTERM or Ctrl-C, and let other programs in.

    Polls at the config's rates, waits for ports that are missing, logs what happens on standard error (JSON when that is no
    terminal). Writes nothing at start. Commands and `servobus.connect()` find it by its socket: SERVOBUS_SOCKET, else in
    $RUNTIME_DIRECTORY, $XDG_RUNTIME_DIR/servobus or /run/servobus. SIGHUP reads CONFIG anew. At the end each servo that was
    enabled is left as its `on_exit` says.

    Example: servobus run config/arm.yaml
    """
    logs(logging.INFO)
    load_config(config)  # what is wrong with it is told before anything is claimed
    if Path(config).stat().st_mode & stat.S_IWOTH:
        raise ConfigError(f"{config}: everybody may write to it, and so say what this daemon does: chmod o-w {config}")
    try:
        run_loop(lambda: serve_rig(config, socket_path(), log_every), terminated=0, endings=[signal.SIGTERM])
    finally:
        log.info("ended")


@click.command()
@click.argument("config", metavar="CONFIG")
@click.option("--folder", type=click.Path(file_okay=False, path_type=Path), help="Also make a link named like each bus here.")
def sim(config: str, folder: Path | None) -> None:
    """Serve the servos of CONFIG, simulated, as serial ports that any program can open.

    Prints one line `BUS PATH` for each bus on standard output and nothing else there, then serves until it is interrupted. The
    config's `port` plays no part, but that realman://... becomes a simulated arm on a TCP port (`BUS realman://127.0.0.1:...`).
    A servo hears only its own baud rate.

    Example: servobus sim config/sim.yaml
    """
    logs()
    setup = load_config(config)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)

    async def main() -> None:
        with anyio.CancelScope():
            await serve(setup.buses, setup.models, lambda name, path: click.echo(f"{name} {path}"), folder=folder)

    run_loop(main, terminated=0)
