"""What happens on a rig without being asked for: servos that come and go, faults, stops, leases. Bounded for every reader."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any
from weakref import WeakSet

BACKLOG = 256  # events that one slow reader may be behind. Older ones are dropped, and the reader sees how many.


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened on a rig.

    Attributes:
        name: A member of `EventName`; from a daemon of another version it may be a name that is not known here.
        time: Monotonic seconds.
        fields: Where it happened and why; which fields there are is said by `EventName`.
        missed: How many events before this one were dropped, because the reader was slow.
    """

    name: str
    time: float
    fields: Mapping[str, Any] = field(default_factory=dict)
    missed: int = 0


class EventStream(AsyncIterator[Event]):
    """The events of one reader, in order, from the moment the stream was made until `aclose`."""

    def __init__(self, backlog: int = BACKLOG) -> None:
        self._events: deque[Event] = deque(maxlen=backlog)
        self._missed = 0
        self._closed = False
        self._changed = asyncio.Event()

    def put(self, event: Event) -> None:
        """Add an event; a full stream drops its oldest."""
        self._missed += len(self._events) == self._events.maxlen
        self._events.append(event)
        self._changed.set()

    async def __anext__(self) -> Event:
        while not self._events:
            if self._closed:
                raise StopAsyncIteration
            self._changed.clear()
            await self._changed.wait()
        event, missed, self._missed = self._events.popleft(), self._missed, 0
        return replace(event, missed=event.missed + missed)

    async def aclose(self) -> None:
        """End the stream: what is in it may still be read."""
        self._closed = True
        self._changed.set()


class EventSource:
    """Hands each event to every subscriber and every stream. A stream that nobody refers to any more is forgotten."""

    def __init__(self) -> None:
        self._subscribers: set[Callable[[Event], None]] = set()
        self._streams: WeakSet[EventStream] = WeakSet()

    def publish(self, event: Event) -> None:
        for subscriber in tuple(self._subscribers):
            subscriber(event)
        for stream in tuple(self._streams):
            stream.put(event)

    def subscribe(self, subscriber: Callable[[Event], None]) -> Callable[[], None]:
        """Call `subscriber` with each event. Returns the function that ends it."""
        self._subscribers.add(subscriber)
        return lambda: self._subscribers.discard(subscriber)

    def stream(self) -> EventStream:
        """A stream of all events from now on."""
        stream = EventStream()
        self._streams.add(stream)
        return stream
