"""KST servos on a bus: a simulated line whose bytes take their time, in virtual time."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, closing
from pathlib import Path
from typing import Any

import pytest

from servobus.bus.service import BusService
from servobus.errors import ReplyTimeout
from servobus.links.faulty import FaultyEnd
from servobus.links.memory import MemoryLink
from servobus.protocols.base import LineTraits
from servobus.protocols.kst import DEFINITION
from servobus.protocols.kst.commissioning import KstCommissioning
from servobus.protocols.kst.driver import KstDriver
from servobus.protocols.kst.simulated.device import KstDevice
from servobus.protocols.options import FaultOptions
from servobus.simulation.line import SimulatedLine
from servobus.values import Goal, Outcome
from tests.protocols.kst.bench import bus_options
from tests.virtual_time import virtual

FAULTS = {
    "whole": FaultOptions(),
    "bytes": FaultOptions(chop="bytes"),
    "random": FaultOptions(chop="random", seed=7),
    "noise": FaultOptions(noise=1.0, seed=2),
    "late": FaultOptions(late=0.1, delay_ms=40, seed=5),
    "loss": FaultOptions(loss=0.1, seed=3),
    "duplicate": FaultOptions(duplicate=0.2, seed=4),
    "wrong_id": FaultOptions(wrong_id=0.1, seed=6),
}


@asynccontextmanager
async def running(
    faults: FaultOptions | None = None, **keys: Any
) -> AsyncIterator[tuple[BusService, list[KstDevice], list[str]]]:
    """Return the service of a bus of two servos, its devices, and the names of its events."""
    loop = asyncio.get_running_loop()
    keys = {"poll": {"feedback": 50, "health": 5}, **keys}
    options = bus_options({"pan": {"id": 1}, "tilt": {"id": 2}}, **keys)
    models = DEFINITION.models(options, Path())
    events: list[str] = []
    servos = [device for device in DEFINITION.devices(options, models) if isinstance(device, KstDevice)]
    line = SimulatedLine(servos, DEFINITION.device_codec(options), loop, baudrate=options.baudrate)
    with closing(line):
        far = line if faults is None else FaultyEnd(line, faults, loop, rename=DEFINITION.rename, node_of=DEFINITION.node_of)
        link = MemoryLink(far, LineTraits(options.baudrate, paced=True, can_change_baud=True))
        driver = DEFINITION.driver(options, models)
        bus = BusService(
            "gimbal", options, driver, DEFINITION.codec(options), link.traits, lambda name, **fields: events.append(name)
        )
        await link.connect(bus.master)
        await bus.start()
        try:
            yield bus, servos, events
        finally:
            await bus.master.close()


async def move(bus: BusService, *, together: bool = False, **goals: float) -> dict[str, Outcome]:
    checked = bus.motion.check({name: Goal("position", value) for name, value in goals.items()})
    futures = bus.motion.put(checked, together=together, confirm=False)
    return {name: await future for name, future in futures.items()}


@virtual
async def test_a_servo_is_identified_enabled_moved_and_stopped() -> None:
    async with running(status_bits={0: "hot"}) as (bus, servos, events):
        servos[1].status_bytes = b"\1\0"
        for name in bus.records:
            await bus.motion.enable(name)
        assert await move(bus, together=True, pan=30, tilt=-30) == {"pan": Outcome.ACKED, "tilt": Outcome.ACKED}
        for name in bus.records:
            await bus.motion.settle(name, tolerance=0, timeout=5)
        assert (servos[0].position, servos[1].position) == (300, -300)
        await asyncio.sleep(0.3)
        state = bus.state("tilt")
        assert (state.position, state.goal, state.faults, state.enabled) == (-30, -30, ("hot",), True)
        reports = await bus.stops.stop()
        assert all(report.confirmed and report.action == "hold" for report in reports.values())
        assert events == []


@pytest.mark.parametrize("name", FAULTS)
def test_every_value_is_right_or_a_typed_error(name: str) -> None:
    @virtual
    async def run() -> None:
        async with running(FAULTS[name]) as (bus, servos, _):
            right = failed = 0
            for number in range(200):
                servos[0].position = servos[0].goal = number - 100  # an answer to an earlier question would be a wrong one
                try:
                    assert await bus.read_register("pan", "position", raw=True) == number - 100
                    assert await bus.read_register("pan", "firmware") == "1.00"
                    assert await bus.read_register("tilt", "id") == 2
                    right += 1
                except ReplyTimeout:
                    failed += 1
            assert right > 150
            assert name in ("late", "loss", "wrong_id") or not failed

    run()


@virtual
async def test_a_servo_that_restarts_is_disabled() -> None:
    """KST RS422, 3.5: after a restart the position is a default value."""
    async with running() as (bus, servos, events):
        await bus.motion.enable("pan")
        await move(bus, pan=80)
        await bus.motion.settle("pan", tolerance=None, timeout=5)
        servos[0].reboot(bus.clock())
        await asyncio.sleep(5)
        assert "servo_restarted" in events
        assert not bus.state("pan").enabled


@virtual
async def test_an_id_is_changed_in_a_session() -> None:
    async with running() as (bus, servos, _), bus.exclusive() as session:
        change = await bus.perform(commissioning(bus).set_id(1, 9, save=True), 1, even_if_offline=True, session=session)
        assert change.saved
        servos[0].reboot(bus.clock())
        await asyncio.sleep(1)
        assert servos[0].node == 9
        plan = commissioning(bus).restarted(1)
        assert plan is not None
        assert await bus.perform(plan, 9, even_if_offline=True, session=session) == 9


def commissioning(bus: BusService) -> KstCommissioning:
    assert isinstance(bus.driver, KstDriver)
    return bus.driver.commissioning
