"""A hand that answers some requests later than the deadline while its registers change: each value is right, or a timeout."""

from __future__ import annotations

import asyncio
import random
from contextlib import closing
from pathlib import Path

from servobus.bus.service import BusService
from servobus.config.loader import parse_config
from servobus.engine.stats import Counter
from servobus.errors import ReplyTimeout
from servobus.links.memory import MemoryLink
from servobus.protocols.base import LineTraits
from servobus.protocols.registry import PROTOCOLS
from servobus.protocols.roh.simulated.device import RohDevice
from servobus.simulation.line import SimulatedLine
from tests.campaigns.faults import HUNG, Result
from tests.virtual_time import VirtualLoop

TEXT = """version: 1
buses:
  hand: {protocol: roh, port: "sim:", baudrate: 115200, timeout_ms: 15, servos: {index: {id: 2, channel: index}}}
"""
REGISTERS = ("1185:1", "1186:1", "1195:1", "1205:1")
"""Settings of one register each: their replies differ in nothing but the value."""
LATE_S = (0.016, 0.030, 0.075, 0.150)
"""Beyond the deadline, by up to ten times."""


def slow_hand(reads: int, seed: int = 1) -> Result:
    """So many reads; every fifth reply comes too late."""
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return runner.run(_slow_hand(reads, random.Random(seed)))


async def _slow_hand(reads: int, rng: random.Random) -> Result:
    config = parse_config(TEXT, "campaign", Path())
    options, definition, result = config.buses["hand"], PROTOCOLS["roh"], Result()
    hands = [hand for hand in definition.devices(options, config.models["hand"]) if isinstance(hand, RohDevice)]
    loop = asyncio.get_running_loop()
    with closing(SimulatedLine(hands, definition.device_codec(options), loop, baudrate=options.baudrate)) as line:
        link = MemoryLink(line, LineTraits(options.baudrate, paced=True))
        driver = definition.driver(options, config.models["hand"])
        bus = BusService("hand", options, driver, definition.codec(options), link.traits, lambda name, **fields: None)
        await link.connect(bus.master)
        await bus.start()
        for number in range(reads):
            await _read(bus, hands[0], number, rng, result)
            await asyncio.sleep(0.05)
        result.turns = bus.stats.counts[Counter.TURNS]
        result.waiting = bus.scheduler.waiting()
        result.counts = {counter.value: count for counter, count in bus.stats.counts.items()}
        await bus.master.close()
    result.leaked = len(asyncio.all_tasks()) - 1
    return result


async def _read(bus: BusService, hand: RohDevice, number: int, rng: random.Random, result: Result) -> None:
    """Each register has a number of its own, another one for each read."""
    for index, register in enumerate(REGISTERS):
        hand._memory[int(register.partition(":")[0])] = (4 * number + index) & 0xFFFF
    hand.extra_delay = rng.choice(LATE_S) if rng.random() < 0.2 else 0.0
    index = rng.randrange(len(REGISTERS))
    asked = bus.clock()
    try:
        (value,) = await bus.read_register("index", REGISTERS[index])
    except ReplyTimeout:
        result.timeouts += 1
    else:
        result.reads += 1
        result.wrong += value != (4 * number + index) & 0xFFFF
    result.hung += bus.clock() - asked > HUNG
