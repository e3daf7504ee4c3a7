"""Subscriptions of all clients: states and statistics at a rate, events as they happen. One timer serves all.

The latest value wins. The times of subscriptions are spread over their period, and the state of a servo is encoded at most once
for all that are served at a moment. A client that does not read is skipped; `missed` in its next notice says how often.
"""

from __future__ import annotations

import asyncio
import heapq
import itertools
from collections.abc import Hashable
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

from servobus.daemon.jsonrpc import encode, notification
from servobus.errors import NotSupported, Overloaded, UnknownName
from servobus.rig.events import Event
from servobus.rig.local import LocalRig
from servobus.rpc.methods import MAX_HZ, MAX_SUBSCRIPTIONS, MIN_HZ, Subscribe
from servobus.timers import CoarseTimer
from servobus.values import State


class Topic(StrEnum):
    STATE = "state"
    EVENTS = "events"
    STATS = "stats"


FIELDS = frozenset(State.__dataclass_fields__)
SAME_MOMENT = 0.004  # seconds for which an encoded state is good for another subscription
SHARE = 64  # subscriptions served in one pass of the loop
SPREAD = 0.618


class Subscriber(Hashable, Protocol):
    """What a subscription needs of the connection of its client."""

    blocked: bool  # the client does not read what was written

    def write(self, data: bytes) -> None: ...


@dataclass(eq=False, slots=True)
class Subscription:
    """`missed` counts the notices that the client did not get."""

    id: int
    client: Subscriber | None
    params: Subscribe
    names: tuple[str, ...]
    due: float
    missed: int = 0

    def __lt__(self, other: Subscription) -> bool:
        return self.due < other.due


class Subscriptions:
    """All subscriptions of one daemon."""

    def __init__(self, rig: LocalRig) -> None:
        self._rig = rig
        self._loop = asyncio.get_running_loop()
        self._numbers = itertools.count(1)
        self._phase = 0.0
        self._heap: list[Subscription] = []
        self._of: dict[Subscriber, dict[int, Subscription]] = {}
        self._timer = CoarseTimer(self._loop, self._tick)
        self._encoded: dict[str, bytes] = {}
        self._encoded_at = -1.0
        self._unlisten = rig.event_source.subscribe(self._event)

    def add(self, client: Subscriber, params: Subscribe) -> int:
        """Begin one, and return its number. Raises NotSupported, UnknownName, Overloaded."""
        if params.topic not in set(Topic):
            raise NotSupported(f"no topic {params.topic!r}: there are {', '.join(Topic)}")
        if not MIN_HZ <= params.hz <= MAX_HZ:
            raise NotSupported(f"{params.hz:g} Hz is outside {MIN_HZ:g} to {MAX_HZ:g}")
        if unknown := set(params.fields) - FIELDS:
            raise UnknownName(f"no field {', '.join(sorted(unknown))}: there are {', '.join(State.__dataclass_fields__)}")
        mine = self._of.setdefault(client, {})
        if len(mine) >= MAX_SUBSCRIPTIONS:
            raise Overloaded(f"{MAX_SUBSCRIPTIONS} subscriptions are enough for one connection: unsubscribe from one")
        names = tuple(self._rig.full_names(params.names)) if params.names else ()
        self._phase = (self._phase + SPREAD) % 1
        due = self._loop.time() + self._phase / params.hz
        added = Subscription(next(self._numbers), client, params, names, due)
        mine[added.id] = added
        if added.params.topic != Topic.EVENTS:
            heapq.heappush(self._heap, added)
            self._arm()
        return added.id

    def remove(self, client: Subscriber, number: int) -> None:
        """End one. Raises UnknownName."""
        subscription = self._of.get(client, {}).pop(number, None)
        if subscription is None:
            raise UnknownName(f"no subscription {number} on this connection")
        subscription.client = None

    def gone(self, client: Subscriber) -> None:
        for subscription in self._of.pop(client, {}).values():
            subscription.client = None

    def close(self) -> None:
        self._unlisten()
        self._timer.cancel()

    def _arm(self) -> None:
        if self._heap:
            self._timer.by(self._heap[0].due)

    def _tick(self) -> None:
        now = self._loop.time()
        for _ in range(SHARE):
            if not self._heap or self._heap[0].due > now:
                break
            subscription = heapq.heappop(self._heap)
            if subscription.client is None:
                continue
            late = now - subscription.due
            period = 1 / subscription.params.hz
            steps = max(1.0, late // period + 1)  # the next point of the grid that has not passed
            subscription.due += steps * period
            heapq.heappush(self._heap, subscription)
            self._send(subscription, subscription.client, int(steps) - 1, now)
        self._arm()

    def _send(self, subscription: Subscription, client: Subscriber, skipped: int, now: float) -> None:
        subscription.missed += skipped
        if client.blocked:
            subscription.missed += 1
            return
        head = b'{"subscription":%d,"missed":%d,' % (subscription.id, subscription.missed)
        if subscription.params.topic == Topic.STATS:
            rest = b'"stats":%b}' % encode(self._rig.stats())
        else:
            rest = b'"stopped":%b,"states":%b}' % (encode(self._rig.stopped), self._states(subscription, now))
        subscription.missed = 0
        client.write(notification(subscription.params.topic, head + rest))

    def _states(self, subscription: Subscription, now: float) -> bytes:
        names = [name for name in subscription.names or self._rig.names if name in self._rig.names]
        if subscription.params.fields:
            states = ((name, self._rig.state(name)) for name in names)
            return encode({name: {key: getattr(state, key) for key in subscription.params.fields} for name, state in states})
        if now - self._encoded_at > SAME_MOMENT:
            self._encoded.clear()
            self._encoded_at = now
        return b"{%b}" % b",".join(map(self._encode, names))

    def _encode(self, name: str) -> bytes:
        state = self._encoded.get(name)
        if state is None:
            state = self._encoded[name] = b"%b:%b" % (encode(name), encode(self._rig.state(name)))
        return state

    def _event(self, event: Event) -> None:
        for client, mine in self._of.items():
            for subscription in mine.values():
                if subscription.params.topic != Topic.EVENTS:
                    continue
                if client.blocked:
                    subscription.missed += 1
                    continue
                head = {"subscription": subscription.id, "missed": subscription.missed}
                params = head | {"name": event.name, "time": event.time, "fields": event.fields}
                subscription.missed = 0
                client.write(notification("event", encode(params)))
