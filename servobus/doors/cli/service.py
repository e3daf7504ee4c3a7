"""Commands that stay: run, sim."""

from __future__ import annotations

import asyncio
import logging
from pathlib import Path

import anyio
import click
import structlog

from servobus.config import load_config
from servobus.doors.cli.common import Number, logs
from servobus.doors.cli.common import run as run_loop
from servobus.local import LocalRig
from servobus.opening import open_rig
from servobus.sim.serve import serve

log = structlog.get_logger("servobus")


@click.command()
@click.argument("config", metavar="CONFIG")
@click.option("--log-every", default=10.0, show_default=True, type=Number(min=0.1), help="Seconds between two lines of state.")
def run(config: str, log_every: float) -> None:
    """Own the ports of CONFIG until SIGTERM or Ctrl-C.

    Polls at the config's rates, waits for ports that are missing, logs what happens on standard error (JSON when that is no
    terminal). Writes nothing at start. At the end each servo that was enabled is left as its `on_exit` says.

    Example: servobus run config/arm.yaml
    """
    logs(logging.INFO)
    setup = load_config(config)

    async def main() -> None:
        async with open_rig(setup, degraded=True) as rig:
            log.info("running", config=config, buses=list(rig.buses))
            while True:
                await asyncio.sleep(log_every)
                _log_state(rig)

    try:
        run_loop(main, terminated=0)
    finally:
        log.info("ended")


def _log_state(rig: LocalRig) -> None:
    """One line for each bus."""
    stats, snapshot = rig.stats(), rig.snapshot()
    for bus, counts in stats.items():
        servos = {name.partition("/")[2]: state for name, state in snapshot.items() if rig.names[name][0] == bus}
        log.info(
            "state",
            bus=bus,
            up=counts["up"],
            load_percent=counts["wire_load_percent"],
            turn_p99_ms=counts["turn_ms"]["p99"],
            timeouts=counts.get("timeouts", 0),
            positions={name: state.position for name, state in servos.items()},
            not_online=[name for name, state in servos.items() if state.health != "online"],
            faults={name: list(state.faults) for name, state in servos.items() if state.faults},
        )


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
