"""A faulty line in virtual time: counts wrong values, awaits that hang and tasks that are left behind.

`faults` damages one reply in a hundred in every way that the fault injector knows. `cancel` cancels callers at random moments on
a faulty line. The values come from an oracle, so every wrong one is noticed. An await that takes longer than any turn may wait
counts as hung. An await that never ends stops the campaign, because the virtual loop notices when everything waits.
"""

from __future__ import annotations

import asyncio
import random
from dataclasses import dataclass, field
from typing import Literal

from servobus.bus.requests import PATIENCE
from servobus.bus.service import BusService
from servobus.engine.stats import Counter
from servobus.errors import ServobusError
from servobus.protocols.options import FaultOptions
from tests.campaigns.oracle import SERVOS, Oracle, service
from tests.virtual_time import VirtualLoop

KINDS = ("loss", "late", "duplicate", "truncate", "drop_byte", "insert_byte", "flip", "wrong_id", "echo")
LATE_MS = 100.0
"""Five times the first deadline of a node."""
HUNG = PATIENCE + 1.0
"""Seconds after which every call has ended: it had its turn within the patience, or it failed."""


@dataclass(slots=True)
class Result:
    """What a campaign counted."""

    reads: int = 0
    wrong: int = 0
    timeouts: int = 0
    cancelled: int = 0
    hung: int = 0
    turns: int = 0
    leaked: int = 0
    waiting: int = 0
    counts: dict[str, int] = field(default_factory=dict)

    def report(self, title: str) -> None:
        print(
            f"{title}: {self.turns} turns, {self.reads} values, {self.wrong} wrong, {self.timeouts} timeouts, "
            f"{self.cancelled} cancelled, {self.hung} hung, {self.leaked} leaked tasks, {self.waiting} still queued"
        )
        print("   " + ", ".join(f"{name} {count}" for name, count in sorted(self.counts.items())))


def options(share: float, *, chop: Literal["whole", "bytes", "random"] = "whole", seed: int = 1) -> FaultOptions:
    """Every kind of fault, together `share` of all replies."""
    each = dict.fromkeys(KINDS, share / len(KINDS))
    return FaultOptions(**each, chop=chop, delay_ms=LATE_MS, seed=seed)


def faults(
    reads: int,
    *,
    protocol: str = "sms",
    share: float = 0.01,
    chop: Literal["whole", "bytes", "random"] = "whole",
    seed: int = 1,
) -> Result:
    """So many reads by twelve callers of ten servos."""
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return runner.run(_faults(reads, protocol, options(share, chop=chop, seed=seed), seed))


async def _faults(reads: int, protocol: str, damage: FaultOptions, seed: int) -> Result:
    result = Result()
    bus, link, oracle = service(protocol, damage)
    await link.connect(bus.master)
    await bus.start()

    async def caller(number: int) -> None:
        rng = random.Random(f"{seed}/{number}")
        while result.reads + result.timeouts < reads:
            await _read(bus, oracle, rng, result, number % SERVOS + 1 if number < SERVOS else rng.randrange(SERVOS) + 1)

    await asyncio.gather(*(caller(number) for number in range(SERVOS + 2)))
    return await _end(bus, result)


async def _read(bus: BusService, oracle: Oracle, rng: random.Random, result: Result, node: int) -> None:
    register = oracle.register(rng)
    clock = asyncio.get_running_loop().time
    asked = clock()
    try:
        value = await bus.read_register(f"s{node}", register, raw=True)
    except ServobusError:
        result.timeouts += 1
    else:
        result.reads += 1
        result.wrong += not oracle.right(value, node, register, asked)
    result.hung += clock() - asked > HUNG


async def _end(bus: BusService, result: Result) -> Result:
    result.turns = bus.stats.counts[Counter.TURNS]
    result.waiting = bus.scheduler.waiting()
    result.counts = {counter.value: count for counter, count in bus.stats.counts.items()}
    await bus.master.close()
    result.leaked = len(asyncio.all_tasks()) - 1
    return result


def cancel(cancels: int, *, protocol: str = "sms", seed: int = 1) -> Result:
    """So many callers cancelled, each at a random moment of its call."""
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return runner.run(_cancel(cancels, protocol, seed))


async def _cancel(cancels: int, protocol: str, seed: int) -> Result:
    result, rng = Result(), random.Random(seed)
    bus, link, oracle = service(protocol, options(0.01, seed=seed))
    await link.connect(bus.master)
    await bus.start()
    while result.cancelled < cancels:
        tasks = [asyncio.create_task(_read(bus, oracle, rng, result, rng.randrange(SERVOS) + 1)) for _ in range(8)]
        for task in rng.sample(tasks, 5):
            for _ in range(rng.randrange(4)):
                await asyncio.sleep(0)
            task.cancel()
        for ended in await asyncio.gather(*tasks, return_exceptions=True):
            if isinstance(ended, asyncio.CancelledError):
                result.cancelled += 1
            elif ended is not None:
                raise ended
    await asyncio.sleep(5)
    return await _end(bus, result)
