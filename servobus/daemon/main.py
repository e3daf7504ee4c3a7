"""The daemon's main: a rig and its clients as a service of the system, with signals, watchdog and a log of states."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import anyio

from servobus.daemon.notify import Notifier
from servobus.daemon.server import NativeDoor, open_door
from servobus.daemon.sockets import claim
from servobus.daemon.watchdog import Pulse, Watchdog
from servobus.engine.stats import Counter
from servobus.errors import ServobusError
from servobus.rig.latch import LatchFile
from servobus.rig.local import LocalRig, open_rig
from servobus.rig.logs import EventLogger

CHECKS = 3  # checks of the buses within the time that the system's watchdog allows

log = EventLogger("servobus.daemon")


async def serve_rig(config: str, path: Path, log_every: float, opened: Callable[[LocalRig], object] = bool) -> None:
    """Run the daemon of a config until it is cancelled; `opened` gets its rig. Raises ConfigError, PortBusy.

    The socket is claimed before a port is opened, so that a second daemon disturbs nothing.
    """
    reloads = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGHUP, reloads.set)  # first: a SIGHUP before READY is done after it
    notifier, listener = Notifier(), claim(path)
    async with (
        open_rig(config, degraded=True, latch=LatchFile(path.with_suffix(".estop"))) as rig,
        open_door(rig, path, owner=os.geteuid(), listener=listener) as door,
        anyio.create_task_group() as group,
    ):
        opened(rig)
        log.info("running", config=config, buses=list(rig.buses), doors=door.addresses, pid=os.getpid())
        notifier.ready(f"{len(rig.buses)} buses, {len(rig.names)} servos")
        group.start_soon(_reload, rig, door, notifier, reloads)
        group.start_soon(_log_states, rig, log_every)
        if notifier.watchdog is not None:
            group.start_soon(_feed, rig, notifier, notifier.watchdog / CHECKS)
        try:
            await anyio.sleep_forever()
        finally:
            notifier.stopping()


async def _reload(rig: LocalRig, door: NativeDoor, notifier: Notifier, asked: asyncio.Event) -> None:
    """Read the config again at each SIGHUP. A wrong file changes nothing and is logged."""
    while True:
        await asked.wait()
        asked.clear()
        notifier.reloading()
        try:
            await rig.reload()
            door.leases.forget_removed()
        except ServobusError as error:
            log.error("reload_refused", reason=str(error))
        notifier.ready(f"{len(rig.buses)} buses, {len(rig.names)} servos")


async def _feed(rig: LocalRig, notifier: Notifier, period: float) -> None:
    """Feed the system's watchdog as long as every bus makes progress."""
    watchdog = Watchdog()
    while True:
        if stuck := watchdog.stuck({name: _pulse(rig, name) for name in rig.buses}):
            log.error("bus_stuck", buses=stuck)
        else:
            notifier.alive()
        await anyio.sleep(period)


def _pulse(rig: LocalRig, name: str) -> Pulse:
    bus = rig.buses[name]
    counts = bus.stats.counts
    return Pulse(bus.master.up, counts[Counter.FRAMES], counts[Counter.BYTES_RECEIVED], bus.scheduler.waiting())


async def _log_states(rig: LocalRig, every: float) -> None:
    while True:
        await anyio.sleep(every)
        with suppress(KeyError):  # a reload just removed the bus
            _log_state(rig)


def _log_state(rig: LocalRig) -> None:
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
