"""Event streams: what a slow reader misses, what ends a stream, and that none is kept for nobody."""

from __future__ import annotations

import asyncio
import gc

import pytest

from servobus.rig.events import BACKLOG, Event, EventSource, EventStream
from servobus.values import EventName
from tests.virtual_time import virtual


@virtual
async def test_a_slow_reader_loses_the_oldest() -> None:
    stream = EventStream()
    for number in range(BACKLOG + 3):
        stream.put(Event(EventName.ESTOP, float(number), missed=number == 3))
    first, second = await anext(stream), await anext(stream)
    assert (first.time, first.missed) == (3.0, 4), "three of this stream, and one that the daemon had dropped before"
    assert (second.time, second.missed) == (4.0, 0)


@virtual
async def test_a_reader_that_waits_is_woken_by_the_end() -> None:
    source = EventSource()
    stream = source.stream()
    reader = asyncio.ensure_future(anext(stream))
    await asyncio.sleep(0)
    await stream.aclose()
    with pytest.raises(StopAsyncIteration):
        await reader


@virtual
async def test_a_stream_that_nobody_has_is_forgotten() -> None:
    source = EventSource()
    stream = source.stream()
    source.publish(Event(EventName.ESTOP, 0.0))
    assert (await anext(stream)).name == EventName.ESTOP
    assert len(source._streams) == 1
    del stream
    gc.collect()
    assert len(source._streams) == 0
