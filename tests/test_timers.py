"""Fine timers, on the loops of the system and on a loop with a time of its own."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Callable, Coroutine
from typing import Any

import pytest
import uvloop

from servobus.timers import FineTimer, clock_of
from tests.virtual_time import VirtualLoop

LOOPS: dict[str, Callable[[], asyncio.AbstractEventLoop]] = {
    "asyncio": asyncio.new_event_loop,
    "uvloop": uvloop.new_event_loop,
    "virtual": VirtualLoop,
}


def on_each_loop(test: Callable[[], Coroutine[Any, Any, None]]) -> Callable[[str], None]:
    @pytest.mark.parametrize("loop", LOOPS)
    def run(loop: str) -> None:
        with asyncio.Runner(loop_factory=LOOPS[loop]) as runner:
            runner.run(test())

    run.__doc__ = test.__doc__
    return run


class Bell:
    """A timer that notes when it rang."""

    def __init__(self) -> None:
        loop = asyncio.get_running_loop()
        self.now = clock_of(loop)
        self.rings: list[float] = []
        self._rung = asyncio.Event()
        self.timer = FineTimer(loop, self._ring)

    def _ring(self) -> None:
        self.rings.append(self.now())
        self._rung.set()

    async def ring(self) -> float:
        """When it rang next."""
        async with asyncio.timeout(20):
            await self._rung.wait()
        self._rung.clear()
        return self.rings[-1]


@on_each_loop
async def test_rings_once_and_not_before() -> None:
    bell, later = Bell(), Bell()
    for delay in (0.0004, 0.003):
        due = bell.now() + delay
        bell.timer.arm(due)
        assert await bell.ring() >= due
    later.timer.arm(later.now() + 0.005)
    await later.ring()
    assert len(bell.rings) == 2
    bell.timer.close()
    later.timer.close()


@on_each_loop
async def test_what_has_passed_rings_at_once() -> None:
    """Time 0 too, which would mean "never" to the system."""
    bell = Bell()
    for past in (0.0, bell.now() - 5, bell.now()):
        bell.timer.arm(past)
        await bell.ring()
    assert len(bell.rings) == 3
    bell.timer.close()


@on_each_loop
async def test_armed_anew_it_forgets_the_earlier_time() -> None:
    bell, other = Bell(), Bell()
    now = bell.now()
    bell.timer.arm(now + 3600)
    bell.timer.arm(now + 0.001)
    assert now + 0.001 <= await bell.ring() < now + 3600
    now = bell.now()
    bell.timer.arm(now + 0.001)
    bell.timer.arm(now + 3600)
    other.timer.arm(now + 0.005)
    await other.ring()
    assert len(bell.rings) == 1
    bell.timer.close()
    other.timer.close()


@on_each_loop
async def test_cancelled_it_does_not_ring() -> None:
    bell, other = Bell(), Bell()
    bell.timer.cancel()  # nothing to cancel
    bell.timer.arm(bell.now() + 0.001)
    bell.timer.cancel()
    other.timer.arm(other.now() + 0.005)
    await other.ring()
    assert bell.rings == []
    bell.timer.arm(bell.now())
    await bell.ring()
    bell.timer.close()
    other.timer.close()


@on_each_loop
async def test_closed_it_does_not_ring_and_may_be_closed_again() -> None:
    bell, other = Bell(), Bell()
    bell.timer.arm(bell.now() + 0.001)
    bell.timer.close()
    bell.timer.close()
    other.timer.arm(other.now() + 0.005)
    await other.ring()
    assert bell.rings == []
    other.timer.close()


@on_each_loop
async def test_of_two_that_cancel_each_other_one_rings() -> None:
    """Both are due in one pass of the loop, so the second was already seen when the first cancels it."""
    loop = asyncio.get_running_loop()
    rung: list[str] = []
    done = loop.create_future()

    def ring(name: str, other: Callable[[], FineTimer]) -> None:
        rung.append(name)
        other().cancel()
        loop.call_soon(lambda: loop.call_soon(done.set_result, None))

    left = FineTimer(loop, lambda: ring("left", lambda: right))
    right = FineTimer(loop, lambda: ring("right", lambda: left))
    due = clock_of(loop)()
    left.arm(due)
    right.arm(due)
    async with asyncio.timeout(20):
        await done
    assert len(rung) == 1
    left.close()
    right.close()


@on_each_loop
async def test_a_callback_may_arm_it_again() -> None:
    loop = asyncio.get_running_loop()
    now, done, left = clock_of(loop), loop.create_future(), [3, 2, 1]

    def ring() -> None:
        left.pop()
        if left:
            timer.arm(now() + 0.0005)
        else:
            done.set_result(None)

    timer = FineTimer(loop, ring)
    timer.arm(now())
    async with asyncio.timeout(20):
        await done
    timer.close()


@pytest.mark.parametrize("loop", ["asyncio", "uvloop"])
def test_a_closed_timer_leaves_no_descriptor(loop: str) -> None:
    async def run() -> None:
        before = set(os.listdir("/proc/self/fd"))
        timers = [FineTimer(asyncio.get_running_loop(), print) for _ in range(10)]
        assert len(set(os.listdir("/proc/self/fd")) - before) >= len(timers)
        for timer in timers:
            timer.close()
        assert set(os.listdir("/proc/self/fd")) <= before

    with asyncio.Runner(loop_factory=LOOPS[loop]) as runner:
        runner.run(run())


def test_the_clock_is_the_systems_unless_the_loop_has_its_own() -> None:
    virtual = VirtualLoop()
    assert clock_of(virtual) == virtual.time
    virtual.close()
    own = uvloop.new_event_loop()
    assert clock_of(own) is time.monotonic
    own.close()
