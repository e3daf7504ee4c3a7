"""Hands on a bus: a simulated line whose bytes take their time, in virtual time."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager, closing, suppress
from pathlib import Path
from typing import Any

import pytest

from servobus.bus.bandwidth import line_bandwidth
from servobus.bus.service import BusService
from servobus.engine.stats import Counter
from servobus.errors import DeviceError, ReplyTimeout
from servobus.links.faulty import FaultyEnd
from servobus.links.memory import MemoryLink
from servobus.protocols.base import LineTraits
from servobus.protocols.device import Device, DeviceReply
from servobus.protocols.modbus.codec import REFUSED, Frame, encode
from servobus.protocols.modbus.requests import NO_ANSWER
from servobus.protocols.options import FaultOptions
from servobus.protocols.roh import DEFINITION
from servobus.protocols.roh.simulated.device import RohDevice
from servobus.simulation.line import SimulatedLine
from servobus.values import Goal, Outcome
from tests.protocols.roh.bench import HAND, bus_options
from tests.virtual_time import virtual

FAULTS = {
    "whole": FaultOptions(),
    "bytes": FaultOptions(chop="bytes"),
    "random": FaultOptions(chop="random", seed=7),
    "noise": FaultOptions(noise=1.0, seed=2),
    "late": FaultOptions(late=0.1, delay_ms=40, seed=5),
    "loss": FaultOptions(loss=0.1, seed=3),
    "duplicate": FaultOptions(duplicate=0.2, seed=4),
    "truncate": FaultOptions(truncate=0.1, seed=8),
    "flip": FaultOptions(flip=0.1, seed=9),
    "wrong_id": FaultOptions(wrong_id=0.1, seed=6),
    "echo": FaultOptions(echo=1.0, seed=1),
}
TWO = {"a": {"id": 2, "channel": "index"}, "b": {"id": 2, "channel": "ring"}, "c": {"id": 3, "channel": "index"}}


class Gateway:
    """What an arm makes of a hand that does not answer: the exception "the unit did not answer", after its own timeout."""

    def __init__(self, hand: RohDevice) -> None:
        self.hand = hand
        self.baudrate = hand.baudrate

    @property
    def node(self) -> int:
        return self.hand.node

    def handle(self, packet: Frame, now: float) -> Sequence[DeviceReply]:
        replies = self.hand.handle(packet, now)
        if replies or packet.unit != self.node:
            return replies
        return (DeviceReply(encode(packet.unit, packet.function | REFUSED, bytes((NO_ANSWER,))), 0.02),)


@asynccontextmanager
async def running(
    servos: dict[str, dict[str, Any]], faults: FaultOptions | None = None, *, behind_arm: bool = False, **keys: Any
) -> AsyncIterator[tuple[BusService, list[RohDevice], list[str]]]:
    """Return the service of a line, its hands, and the names of its events."""
    loop = asyncio.get_running_loop()
    options = bus_options(servos, **{"poll": {"feedback": 20, "health": 5}, **keys})
    models = DEFINITION.models(options, Path())
    events: list[str] = []
    hands = [device for device in DEFINITION.devices(options, models) if isinstance(device, RohDevice)]
    nodes: list[Device] = [Gateway(hand) if behind_arm else hand for hand in hands]
    line = SimulatedLine(nodes, DEFINITION.device_codec(options), loop, baudrate=options.baudrate)
    with closing(line):
        far = line if faults is None else FaultyEnd(line, faults, loop, rename=DEFINITION.rename, node_of=DEFINITION.node_of)
        paced = faults is None or not faults.echo
        carried = (12, 10) if behind_arm else (None, None)
        traits = LineTraits(options.baudrate, paced=paced, can_change_baud=True, max_read=carried[0], max_write=carried[1])
        link = MemoryLink(far, traits)
        driver = DEFINITION.driver(options, models)
        bus = BusService(
            "hand", options, driver, DEFINITION.codec(options), link.traits, lambda name, **fields: events.append(name)
        )
        await link.connect(bus.master)
        await bus.start()
        try:
            yield bus, hands, events
        finally:
            await bus.master.close()


async def move(bus: BusService, **goals: float) -> dict[str, Outcome]:
    checked = bus.motion.check({name: Goal("position", value) for name, value in goals.items()})
    futures = bus.motion.put(checked, together=False, confirm=False)
    return {name: await future for name, future in futures.items()}


@virtual
async def test_a_hand_is_identified_enabled_moved_and_stopped() -> None:
    async with running(HAND) as (bus, hands, events):
        for name in HAND:
            await bus.motion.enable(name)
        assert hands[0].written == [(1125 + number, 65534) for number in range(6)], "one less than the hand starts with"
        hands[0].written.clear()
        before = bus.stats.counts[Counter.FRAMES]
        results = await move(bus, **dict.fromkeys(HAND, 40.0))
        assert set(results.values()) == {Outcome.ACKED}
        assert hands[0].written == [(1135 + number, 26214) for number in range(6)]
        assert bus.scheduler.goals.turns == 1
        assert bus.stats.counts[Counter.FRAMES] - before < 6
        for name in HAND:
            await bus.motion.settle(name, tolerance=None, timeout=5)
        await asyncio.sleep(0.5)
        state = bus.state("ring")
        assert (state.position, state.goal, state.enabled, state.moving, state.current) == (40, 40, True, False, 0)
        hands[0].fingers[3].obstacle = 30000
        await move(bus, ring=100)
        await asyncio.sleep(2)
        assert bus.state("ring").faults == ("stuck",)
        assert bus.state("index").faults == ()
        reports = await bus.stops.stop()
        assert all(report.confirmed and report.action == "hold" for report in reports.values())
        assert events == []


@pytest.mark.parametrize("name", FAULTS)
def test_every_value_is_right_or_a_typed_error(name: str) -> None:
    @virtual
    async def run() -> None:
        async with running(TWO, FAULTS[name]) as (bus, hands, _):
            right = failed = 0
            for number in range(150):
                # An answer to an earlier question would be a wrong one: the registers are as many, and their values change.
                hands[0]._memory[1186], hands[0]._memory[1188], hands[1]._memory[1186] = number, 1000 + number, 2000 + number
                try:
                    assert await bus.read_register("a", "stall_speed") == number
                    assert await bus.read_register("b", "stall_speed") == 1000 + number
                    assert await bus.read_register("c", "stall_speed") == 2000 + number
                    right += 1
                except ReplyTimeout:
                    failed += 1
            assert right > 100
            assert name not in ("whole", "bytes", "random", "duplicate") or not failed

    run()


@virtual
async def test_a_late_reply_of_a_slow_hand_is_not_used() -> None:
    async with running({"a": TWO["a"]}, timeout_ms=15) as (bus, hands, _):
        right = 0
        for number in range(2000):
            hands[0]._memory[1186] = number
            hands[0].extra_delay = 0.030 if number % 7 == 0 else 0.0
            try:
                assert await bus.read_register("a", "stall_speed") == number
                right += 1
            except ReplyTimeout:
                continue
        assert right > 500


@virtual
async def test_all_fingers_of_a_hand_that_restarts_are_disabled() -> None:
    async with running(TWO) as (bus, hands, events):
        for name in TWO:
            await bus.motion.enable(name)
        await move(bus, a=80, b=80, c=80)
        for name in TWO:
            await bus.motion.settle(name, tolerance=None, timeout=5)
        hands[0].reboot(bus.clock())
        await asyncio.sleep(8)
        assert [bus.state(name).enabled for name in TWO] == [False, False, True]
        assert events.count("servo_restarted") == 2


@virtual
async def test_a_map_that_is_not_the_pinned_one_is_reported_and_refused() -> None:
    async with running({"a": TWO["a"]}, units={2: {"model": "v1"}}) as (bus, hands, events):
        hands[0].poke("protocol_version", 0, 0x0200)
        identity = await bus.identify("a")
        assert "config pins v1" in identity.notes[0]
        assert identity.obstacle == identity.notes[0]
        assert "servo_note" in events
        with pytest.raises(DeviceError, match="config pins v1"):
            await bus.motion.enable("a")
        assert bus.state("a").faults == ("register_map",)
        assert hands[0].written == []


@virtual
async def test_a_refusal_has_its_reason_unless_the_line_goes_down() -> None:
    async with running({"a": TWO["a"]}) as (bus, hands, _):
        hands[0].refuses_reads_while_busy, hands[0].state, hands[0]._ready = True, "init", 99.0
        with pytest.raises(DeviceError, match="it is still initialising") as caught:
            await bus.read_register("a", "stall_speed")
        assert caught.value.code == 4
        message, refused = str(caught.value), bus.stats.turns.count
        reading = asyncio.create_task(bus.read_register("a", "stall_speed"))
        for _ in range(1000):
            await asyncio.sleep(0.0005)
            if bus.stats.turns.count > refused:
                break
        bus.master.connection_lost(None)
        with pytest.raises(DeviceError) as caught:
            await reading
        assert caught.value.code == 4
        assert message.startswith(str(caught.value) + "; ")


@virtual
async def test_silence_stands_between_frames() -> None:
    """3.5 characters; 1.75 ms above 19200 baud."""
    results: list[tuple[bool, float]] = []
    async with running({"a": TWO["a"]}) as (bus, _, _):
        bus.master.trace = lambda sent, data, now: results.append((sent, now))
        for _ in range(20):
            await bus.read_register("a", "pos")
    answered = [now for sent, now in results if not sent]
    asked = [now for sent, now in results if sent]
    assert len(asked) > 20
    assert all(min(now - before for before in answered if before <= now) >= 0.00175 - 1e-9 for now in asked[1:])


def test_the_bandwidth_of_a_line_is_counted_before_it_is_opened() -> None:
    options = bus_options(HAND, poll={"feedback": 20}, goal_rate=20)
    driver = DEFINITION.driver(options, DEFINITION.models(options, Path()))
    load = line_bandwidth(options, driver, LineTraits(options.baudrate))
    # A write of six and its answer are 29 bytes, a read of six 25; each has its silence and the usual turnaround.
    assert load.shares["goals"] == pytest.approx(100 * 20 * (29 * 10 / 115_200 + 0.00175 + 0.0005))
    assert load.shares["feedback"] == pytest.approx(100 * 20 * (25 * 10 / 115_200 + 0.00175 + 0.0005))


@virtual
async def test_all_fingers_of_a_slow_hand_are_enabled_and_disabled_at_once() -> None:
    """Each takes some turns and a pause, so the last one waits for seconds."""
    async with running(HAND, behind_arm=True, poll={}) as (bus, hands, _):
        hands[0].delay = 0.08
        for _ in range(10):  # its deadline is learned
            with suppress(ReplyTimeout):
                await bus.read("index")
        began = bus.clock()
        await asyncio.gather(*map(bus.motion.enable, HAND))
        assert bus.clock() - began > 3
        assert all(bus.state(name).enabled for name in HAND)
        await asyncio.gather(*map(bus.motion.disable, HAND))
