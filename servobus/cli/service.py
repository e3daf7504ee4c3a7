"""Commands that run for a while: run, sim, demo."""

from __future__ import annotations

import logging
import signal
import stat
from pathlib import Path

import click

from servobus.cli.options import Number, json_option
from servobus.cli.output import echo
from servobus.errors import ConfigError


@click.command()
@click.argument("config", metavar="CONFIG")
@click.option("--log-every", default=10.0, show_default=True, type=Number(min=0.1), help="Seconds between logs of each bus.")
def run(config: str, log_every: float) -> None:
    """Own the ports of CONFIG as a daemon, and serve other programs. Ends on SIGTERM or Ctrl-C.

    Polls at the rates of the config, waits for ports that are missing, and logs on standard error (as JSON where that is not a
    terminal). Writes nothing to a servo at start. Commands and `servobus.connect()` find the daemon by its socket: at
    SERVOBUS_SOCKET, else in $RUNTIME_DIRECTORY, $XDG_RUNTIME_DIR/servobus or /run/servobus. SIGHUP reads CONFIG again. At the end
    servobus does the `on_exit` of each servo that is enabled, and says so; a second signal ends it at once.

    Example: servobus run config/arm.yaml
    """
    from servobus.cli.ending import of_command
    from servobus.cli.event_loop import run as run_loop
    from servobus.cli.logs import set_up_logs
    from servobus.config.loader import load_config
    from servobus.daemon.main import serve_rig
    from servobus.rig.local import LocalRig
    from servobus.rig.logs import EventLogger
    from servobus.rpc.socket_path import socket_path

    set_up_logs(logging.INFO)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # until the daemon reads its config again at each SIGHUP
    load_config(config)  # a wrong config is refused before the socket is claimed
    if Path(config).stat().st_mode & stat.S_IWOTH:
        raise ConfigError(f"{config}: every user may write to it, and so decide what this daemon does: run chmod o-w {config}")
    log, ending = EventLogger("servobus.cli"), of_command()
    ending.say = lambda text: log.warning("ending", text=text)

    def opened(rig: LocalRig) -> None:
        ending.energised = rig.to_leave

    try:
        run_loop(lambda: serve_rig(config, socket_path(), log_every, opened), terminated=0, signals=[signal.SIGTERM])
    finally:
        log.info("ended")


@click.command()
@click.argument("config", metavar="CONFIG")
@click.option("--folder", type=click.Path(file_okay=False, path_type=Path), help="Also make a link to each port here.")
def sim(config: str, folder: Path | None) -> None:
    """Serve the servos of CONFIG, simulated, as serial ports. Any program can open them. Ends on SIGTERM or Ctrl-C.

    Prints one line `BUS PATH` for each bus on standard output, and nothing else there. The config's `port` is ignored, but for
    realman://...: it becomes a simulated arm on a TCP port (`BUS realman://127.0.0.1:...`). A servo receives only what is sent at
    its own baud rate.

    Example: servobus sim config/sim.yaml
    """
    from servobus.cli.event_loop import run as run_loop
    from servobus.cli.logs import set_up_logs
    from servobus.config.loader import load_config
    from servobus.simulation.serve import serve

    set_up_logs()
    parsed = load_config(config)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)

    def announce(bus: str, path: str) -> None:
        echo(f"{bus} {path}")

    run_loop(lambda: serve(parsed.buses, parsed.models, announce, folder=folder), terminated=0)


@click.command()
@click.option("--seconds", default=10.0, show_default=True, type=Number(0.5, 3600), help="Time to stream goals.")
@json_option
def demo(seconds: float, as_json: bool) -> int:
    """Stream goals to 20 simulated servos on four lines. Prints what the lines carried, with real wire time.

    Six STS at 1 Mbaud, four SMS at 115200 baud, four KST at 512000 baud and the six fingers of a ROH hand at 115200 baud. One
    caller for each servo sends 100 goals a second; feedback is polled at 50 Hz.

    Example: servobus demo --seconds 3
    """
    from servobus.cli.demo import stream
    from servobus.cli.event_loop import run as run_loop
    from servobus.cli.logs import set_up_logs

    set_up_logs(logging.ERROR)
    return run_loop(lambda: stream(seconds, as_json=as_json))
