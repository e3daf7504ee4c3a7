"""What happens on a rig without being asked for: servos that come and go, faults, stops, leases. Bounded for every listener."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

BACKLOG = 256
"""Events that one slow listener may be behind; older ones are lost, and it is told how many."""


@dataclass(frozen=True, slots=True)
class Event:
    """`name` says what (`servo_offline`, `estop`, `line_down`, `lease_lost` ...), `fields` where and why."""

    name: str
    """An `EventName`; from a daemon of another version it may be one that is not known here."""
    time: float
    """Monotonic seconds."""
    fields: Mapping[str, Any] = field(default_factory=dict)
    missed: int = 0
    """Events lost before this one, because the listener was slow."""


class Feed:
    """The events of one listener, in order; the oldest are dropped when it is too slow."""

    def __init__(self, backlog: int = BACKLOG) -> None:
        self._waiting: deque[Event] = deque(maxlen=backlog)
        self._missed = 0
        self._some = asyncio.Event()

    def put(self, event: Event) -> None:
        self._missed += len(self._waiting) == self._waiting.maxlen
        self._waiting.append(event)
        self._some.set()

    async def get(self) -> Event:
        while not self._waiting:
            self._some.clear()
            await self._some.wait()
        event, missed, self._missed = self._waiting.popleft(), self._missed, 0
        return Event(event.name, event.time, event.fields, event.missed + missed)


class Announcer:
    """Hands each event to everyone who listens."""

    def __init__(self) -> None:
        self._listeners: set[Callable[[Event], None]] = set()

    def tell(self, event: Event) -> None:
        for listener in tuple(self._listeners):
            listener(event)

    def listen(self, listener: Callable[[Event], None]) -> Callable[[], None]:
        """Returns what ends it."""
        self._listeners.add(listener)
        return lambda: self._listeners.discard(listener)

    async def events(self) -> AsyncIterator[Event]:
        """From now on, until the iteration is left."""
        feed = Feed()
        unlisten = self.listen(feed.put)
        try:
            while True:
                yield await feed.get()
        finally:
            unlisten()
