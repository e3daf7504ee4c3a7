"""The master and its plug: a line that is lost, and comes back."""

from __future__ import annotations

import asyncio

import pytest

from servobus.engine.job import Job
from servobus.engine.stats import Counter
from servobus.errors import LinkDown, Overloaded
from tests.engine.scripted_line import puppet_bus
from tests.virtual_time import virtual

# The plug


@virtual
async def test_a_lost_line_ends_everything_and_comes_back() -> None:
    async with puppet_bus() as (bus, puppet, link, _):
        puppet.script = lambda frame: []
        calls = [asyncio.create_task(bus.read_register(servo, "present_position")) for servo in ("s1", "s2", "s1")]
        closed = asyncio.create_task(bus.master.wait_closed())
        await asyncio.sleep(0.001)
        link.unplug()
        for call in calls:
            with pytest.raises(LinkDown, match="plug"):
                await call
        await closed
        assert not bus.master.up
        assert repr(bus.master) == "arm: 2 nodes, 0 in flight, 0 queued"
        for attempt in (bus.read_register("s1", "id"), bus.ping("s1")):
            with pytest.raises(LinkDown, match="down"):
                await attempt
        reports = await bus.stops.stop()
        assert not any(report.written for report in reports.values())
        puppet.script = lambda frame: None
        link.plug()
        await link.connect(bus.master)
        assert await bus.read_register("s1", "present_position", raw=True) == 0
        assert bus.stats.counts[Counter.LINE_LOST] == 1


@virtual
async def test_the_queue_is_bounded() -> None:
    async with puppet_bus() as (bus, puppet, _, _):
        puppet.script = lambda frame: []
        futures = [asyncio.get_running_loop().create_future() for _ in range(2000)]
        refused = 0
        for future in futures:
            job = Job(future, bus.clock() + 60, request=bus.driver.read_register("s1", "id"))
            try:
                bus.master.submit(job)
            except Overloaded:
                refused += 1
        assert refused == 2000 - 1024 - 1, "one is on the wire and 1024 wait"


@virtual
async def test_the_baud_rate_changes_between_turns() -> None:
    async with puppet_bus() as (bus, puppet, _, _):
        bus.set_baudrate(115200)
        assert puppet.baudrates == [115200]
        assert bus.line.traits.baudrate == 115200
        assert await bus.read_register("s1", "present_position", raw=True) == 0
