"""Days of a bus in virtual time: 16 servos are polled at 100 Hz and moved all the time, on a line with faults.

Four things are kept in view: the grid of the polls does not drift, nothing grows, the counters add up, and nobody is lost.
The simulated line has its wire time; the clock is virtual, so the days take as long as the computer needs for their turns.
"""

from __future__ import annotations

import asyncio
import gc
import itertools
import math
import sys
import time
from collections import Counter as Tally
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from servobus.bus.service import BusService
from servobus.config.loader import parse_config
from servobus.errors import ServobusError
from servobus.protocols.base import Poll, Request
from servobus.protocols.registry import PROTOCOLS
from servobus.simulation.link import simulated_link
from servobus.values import Goal, Health, Update
from tests.virtual_time import VirtualLoop

SERVOS, HZ = 16, 100.0
GROUP_PERIOD, SINGLE_PERIOD = 0.1, 0.37
"""Seconds between two goals of all servos, and between two goals of one servo that are confirmed."""
SAMPLE = 600.0
"""Virtual seconds between two looks at what is allocated."""
MAX_GROWTH = 2000
"""Memory blocks over the whole time: a bus keeps up to 1024 durations of turns until it folds them into its histogram."""
MAX_DRIFT = 1e-3
"""Seconds: what the rounding of ten million periods may add up to."""
TEXT = """version: 1
buses:
  line:
    protocol: sms
    port: "sim:"
    baudrate: 1000000
    poll: {feedback: 100}
    faults: {loss: 0.001, flip: 0.001, late: 0.0005, truncate: 0.0005, insert_byte: 0.0005, delay_ms: 60, seed: 7}
    servos:
"""


@dataclass(slots=True)
class Days:
    """What the days brought."""

    hours: float = 0.0
    seconds: float = 0.0
    """Of real time."""
    taken: int = 0
    """Polls that the grid handed out."""
    due: int = 0
    """Polls that a grid without drift hands out in that time."""
    missed: int = 0
    drift: float = 0.0
    """Greatest distance of a poll that was due from its place in the grid, in s."""
    blocks: list[int] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    events: Tally[str] = field(default_factory=Tally)
    outcomes: Tally[str] = field(default_factory=Tally)
    asked: int = 0
    waiting: int = 0
    online: int = 0

    @property
    def growth(self) -> float:
        """Memory blocks an hour, from the mean of the first and of the last quarter of the looks."""
        quarter = max(1, len(self.blocks) // 4)
        first, last = (sum(part) / len(part) for part in (self.blocks[:quarter], self.blocks[-quarter:]))
        span = (len(self.blocks) - quarter) * SAMPLE / 3600
        return (last - first) / span if span else 0.0

    def balance(self) -> dict[str, int]:
        """What has to be 0 if the counters add up."""
        count = self.counts.__getitem__
        ended = sum(count(name) for name in ("goals_acked", "goals_sent", "goals_superseded", "goals_failed"))
        return {
            "polls taken and missed": max(0, abs(self.taken + self.missed - self.due) - 1),  # the last may not be due yet
            "goals put and asked for": count("goals") - self.asked,
            "goals that did not end": count("goals") - ended,
            "outcomes that callers did not get": self.asked - self.outcomes.total(),
            "still waiting": self.waiting,
            "servos lost": SERVOS - self.online,
        }

    def kept(self) -> bool:
        return not any(self.balance().values()) and self.drift < MAX_DRIFT and self.growth * self.hours < MAX_GROWTH

    def report(self) -> None:
        rate = self.hours * 3600 / self.seconds
        print(
            f"{self.hours:g} h of {SERVOS} servos at {HZ:g} Hz in {self.seconds:.0f} s ({rate:.0f} times as fast as time; "
            f"72 h take {72 / rate:.1f} h)"
        )
        print(f"   polls: {self.taken} taken, {self.missed} missed, {self.due} due; greatest drift {1e9 * self.drift:.3f} ns")
        print(f"   memory: {self.blocks[0]} blocks at first, {self.blocks[-1]} at last, {self.growth:+.1f} an hour")
        print("   outcomes: " + ", ".join(f"{name} {number}" for name, number in sorted(self.outcomes.items())))
        print("   counters: " + ", ".join(f"{name} {number}" for name, number in sorted(self.counts.items()) if number))
        print("   events: " + ", ".join(f"{name} {number}" for name, number in sorted(self.events.items())))
        print("   has to be 0: " + ", ".join(f"{name} {number}" for name, number in self.balance().items()))


def days(hours: float) -> Days:
    """So many hours of virtual time."""
    result = Days(hours=hours)
    began = time.monotonic()
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        runner.run(_days(result))
    result.seconds = time.monotonic() - began
    return result


async def _days(result: Days) -> None:
    servos = "".join(f"      s{number}: {{id: {number}, model: sts}}\n" for number in range(1, SERVOS + 1))
    config = parse_config(TEXT + servos, "campaign", Path())
    options, models = config.buses["line"], config.models["line"]
    link, definition = simulated_link(options, models), PROTOCOLS["sms"]
    event = _counted(result.events)
    bus = BusService("line", options, definition.driver(options, models), definition.codec(options), link.traits, event)
    await link.connect(bus.master)
    await bus.start()
    for servo in bus.records:
        await _enable(bus, servo)
    began = bus.clock()
    result.missed = -bus.scheduler.polls.missed  # while the servos were enabled
    bus.scheduler.set_polls([_watched(poll, bus, began, result) for poll in bus.driver.polls({"feedback": HZ})], began)
    end = began + 3600 * result.hours
    movers = [_groups(bus, result, end), _singles(bus, result, end), _samples(bus, result, end)]
    await asyncio.gather(*movers)
    await _finish(bus, result, bus.clock() - began)
    await bus.master.close()
    link.close()


async def _finish(bus: BusService, result: Days, elapsed: float) -> None:
    """Let the last poll and the last goals end, and note what was counted."""
    result.due = math.ceil(elapsed * HZ)
    result.missed += bus.scheduler.polls.missed
    bus.scheduler.set_polls([], bus.clock())
    await asyncio.sleep(10)
    result.counts = {counter.value: count for counter, count in bus.stats.counts.items()}
    result.waiting = bus.scheduler.waiting()
    result.online = sum(record.node.health is Health.ONLINE for record in bus.records.values())


def _counted(events: Tally[str]) -> Callable[..., None]:
    def event(name: str, **_: object) -> None:
        events[name] += 1

    return event


def _watched(poll: Poll, bus: BusService, began: float, result: Days) -> Poll:
    """The same poll, which notes how far the time at which it is due next is from its place in the grid."""

    def request(reachable: Collection[int]) -> Request[dict[str, Update]] | None:
        result.taken += 1
        polls = bus.scheduler.polls
        result.drift = max(result.drift, abs(polls.due - began - (result.taken + polls.missed + result.missed) / HZ))
        return poll.request(reachable)

    return replace(poll, request=request)


async def _enable(bus: BusService, servo: str) -> None:
    while True:
        try:
            return await bus.motion.enable(servo)
        except ServobusError:
            await asyncio.sleep(0.1)


async def _groups(bus: BusService, result: Days, end: float) -> None:
    """All servos are moved to and fro in one frame."""
    for number in itertools.count():
        if bus.clock() >= end:
            return
        _put(bus, result, dict.fromkeys(bus.records, 20.0 * (-1) ** number), confirm=False)
        await asyncio.sleep(GROUP_PERIOD)


async def _singles(bus: BusService, result: Days, end: float) -> None:
    """One servo after the other gets a goal that it confirms."""
    names: Sequence[str] = list(bus.records)
    for number in itertools.count():
        if bus.clock() >= end:
            return
        _put(bus, result, {names[number % len(names)]: 10.0}, confirm=True)
        await asyncio.sleep(SINGLE_PERIOD)


def _put(bus: BusService, result: Days, positions: dict[str, float], *, confirm: bool) -> None:
    """A servo that was disabled (a restart, torque that is gone) is counted, and enabled again."""
    for servo, position in positions.items():
        try:
            goals = bus.motion.check({servo: Goal("position", position)})
        except ServobusError as error:
            result.events[f"refused: {type(error).__name__}"] += 1
            continue
        result.asked += 1
        (future,) = bus.motion.put(goals, together=False, confirm=confirm).values()
        future.add_done_callback(lambda future: _ended(result, future))


def _ended(result: Days, future: asyncio.Future[Any]) -> None:
    error = future.exception()
    result.outcomes[future.result() if error is None else type(error).__name__] += 1


async def _samples(bus: BusService, result: Days, end: float) -> None:
    while bus.clock() < end:
        gc.collect()
        result.blocks.append(sys.getallocatedblocks())
        await asyncio.sleep(min(SAMPLE, max(1e-9, end - bus.clock())))
