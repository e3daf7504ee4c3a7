"""Leases on a rig: whose servos they are, and what becomes of those of a client that is gone."""

from __future__ import annotations

import asyncio
from collections.abc import Collection, Hashable, Iterable

from servobus.daemon.leases import Leases
from servobus.rig.events import Event
from servobus.rig.local import LocalRig
from servobus.rig.logs import EventLogger
from servobus.values import EventName

log = EventLogger("servobus.daemon")
STOPPING = "the client that moved it is gone, and it is being stopped: wait a moment"


class LeaseWatch:
    """One for each door. Times are the loop's."""

    def __init__(self, rig: LocalRig, ttl: float) -> None:
        self.leases = Leases(ttl)
        self._rig = rig
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None
        self._timer_at = 0.0
        self._labels: dict[Hashable, str] = {}
        self._stopping: set[asyncio.Task[None]] = set()

    def check(self, client: Hashable, servos: Iterable[str]) -> None:
        """Raises LeaseHeld."""
        self.leases.check(client, servos)

    def take(self, client: Hashable, label: str, servos: Collection[str]) -> None:
        """By moving. Raises LeaseHeld."""
        self._labels[client] = label
        self.leases.take(client, label, servos, self._loop.time())
        self._watch()

    def acquire(self, client: Hashable, label: str, servos: Collection[str]) -> set[str]:
        """Raises LeaseHeld."""
        self._labels[client] = label
        self.leases.acquire(client, label, servos, self._loop.time())
        self._watch()
        return self.leases.held_by(client)

    def renew(self, client: Hashable) -> set[str]:
        return self.leases.renew(client, self._loop.time())

    def release(self, client: Hashable, servos: Collection[str]) -> None:
        self.leases.release(client, servos)

    def gone(self, client: Hashable) -> None:
        """Its connection is closed."""
        servos = self.leases.gone(client)
        label = self._labels.pop(client, "")
        if servos:
            self._lose(label, servos, "its connection is closed")

    def reloaded(self) -> None:
        """Servos that are in the config no more belong to nobody."""
        self.leases.forget(set(self.leases.holders()) - set(self._rig.names))

    async def close(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        await asyncio.gather(*self._stopping)

    def _watch(self) -> None:
        expiry = self.leases.next_expiry()
        if expiry is not None and (self._timer is None or self._timer_at > expiry):
            self._arm(expiry)

    def _arm(self, when: float) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer_at = when
        self._timer = self._loop.call_at(when, self._expire)

    def _expire(self) -> None:
        self._timer = None
        for client, servos in self.leases.expire(self._loop.time()).items():
            self._lose(self._labels.get(client, ""), servos, "it did not renew its lease in time")
        self._watch()

    def _lose(self, label: str, servos: set[str], reason: str) -> None:
        known = servos & set(self._rig.names)
        self.leases.block(known, STOPPING)
        log.warning("lease_lost", client=label, servos=sorted(servos), reason=reason)
        fields = {"client": label, "servos": sorted(servos), "reason": reason}
        self._rig.event_source.publish(Event(EventName.LEASE_LOST, self._loop.time(), fields))
        task = asyncio.create_task(self._stop(known))
        self._stopping.add(task)
        task.add_done_callback(self._stopping.discard)

    async def _stop(self, servos: set[str]) -> None:
        try:
            reports = await self._rig.abandon(servos)
            doubtful = {name: report.detail for name, report in reports.items() if not report.confirmed}
            if doubtful:
                log.warning("lost_client_unconfirmed", servos=doubtful)
        finally:
            self.leases.unblock(servos)
