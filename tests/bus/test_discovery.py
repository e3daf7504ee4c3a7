"""Who is there: servos that come late, restarts that end a pending change."""

from __future__ import annotations

import asyncio
from contextlib import suppress

from servobus.engine.scheduler import QUEUE_LIMIT
from servobus.errors import Overloaded, ReplyTimeout
from servobus.protocols.base import Plan, ask
from servobus.protocols.sms.driver import SmsDriver
from servobus.rig.local import open_rig
from servobus.values import Change
from tests.engine.scripted_line import puppet_bus
from tests.simulated_rigs import config, devices
from tests.virtual_time import virtual


@virtual
async def test_a_servo_that_comes_while_the_queue_is_full_is_identified() -> None:
    async with puppet_bus(started=False) as (bus, puppet, _, _):
        puppet.script = lambda frame: [] if frame[2] == 2 else None
        await bus.start()

        async def caller() -> None:
            while True:
                with suppress(Overloaded, ReplyTimeout):
                    await bus.read_register("s1", "present_position")

        callers = [asyncio.create_task(caller()) for _ in range(QUEUE_LIMIT + 100)]
        await asyncio.sleep(0.1)
        puppet.script = lambda frame: None
        await asyncio.sleep(1.5)
        for each in callers:
            each.cancel()
        await asyncio.gather(*callers, return_exceptions=True)
        assert bus.state("s2").health == "online"
        assert bus.records["s2"].identity is not None


class PendingChanges:
    """Maintenance of a protocol where a new id takes effect at the next restart."""

    commands: dict[str, str] = {}

    def __init__(self, driver: SmsDriver) -> None:
        self.driver = driver
        self.restarts: list[int] = []

    def set_id(self, node: int, new: int, *, save: bool = False) -> Plan[Change]:
        raise AssertionError

    def restarted(self, node: int) -> Plan[None]:
        yield from ask(self.driver.ping(node))
        self.restarts.append(node)


@virtual
async def test_a_node_that_comes_back_may_have_restarted() -> None:
    async with puppet_bus() as (bus, puppet, _, _):
        assert isinstance(bus.driver, SmsDriver)
        changes = PendingChanges(bus.driver)
        bus.driver.commissioning = changes  # type: ignore[assignment]
        puppet.script = lambda frame: [] if frame[2] == 1 else None
        with suppress(ReplyTimeout):
            await bus.read_register("s1", "id")
        await asyncio.sleep(1)
        assert bus.state("s1").health == "offline"
        assert changes.restarts == []
        puppet.script = lambda frame: None
        await asyncio.sleep(5)
        assert changes.restarts == [1]


@virtual
async def test_a_servo_that_is_energised_at_the_start_is_named() -> None:
    async with open_rig(config()) as first:
        await first.enable("s1")
        servo = devices(first)[1]
        events = first.events()
        bus = first.buses["arm"]
        bus.records["s1"].touched, bus.records["s1"].identity = False, None
        await bus.identify("s1")
        event = await anext(events)
        assert (event.name, event.fields["servo"]) == ("servo_note", "s1")
        assert "torque is on" in event.fields["note"]
        assert servo.get("torque_enable") == 1, "nothing was written"
