"""The motion leases of a rig in time: when they end, and what becomes of the servos of a client that is lost."""

from __future__ import annotations

import asyncio
from collections.abc import Collection, Hashable

from servobus.daemon.leases import Leases
from servobus.rig.events import Event
from servobus.rig.local import LocalRig
from servobus.rig.logs import EventLogger
from servobus.timers import CoarseTimer
from servobus.values import EventName

log = EventLogger("servobus.daemon")
STOPPING = "its client is lost, and it is being stopped: wait a moment"


class LeaseWatch:
    """One for each daemon. `lease_ms`: how long a lease lasts without a renewal."""

    def __init__(self, rig: LocalRig, lease_ms: int) -> None:
        self.lease_ms = lease_ms
        self.leases = Leases(lease_ms / 1000)
        self.holders, self.check, self.release = self.leases.holders, self.leases.check, self.leases.release
        self.give_back = self.leases.give_back
        self._rig = rig
        self._loop = asyncio.get_running_loop()
        self._timer = CoarseTimer(self._loop, self._expire)
        self._labels: dict[Hashable, str] = {}
        self._stopping: set[asyncio.Task[None]] = set()

    def take(self, client: Hashable, label: str, servos: Collection[str]) -> dict[str, int]:
        """Take servos by moving them; see `Leases.take`. Raises LeaseHeld."""
        self._labels[client] = label
        taken = self.leases.take(client, label, servos, self._loop.time())
        self._watch()
        return taken

    def acquire(self, client: Hashable, label: str, servos: Collection[str]) -> set[str]:
        """Take servos on request, and return all that the client holds. Raises LeaseHeld."""
        self._labels[client] = label
        held = self.leases.acquire(client, label, servos, self._loop.time())
        self._watch()
        return held

    def renew(self, client: Hashable) -> set[str]:
        return self.leases.renew(client, self._loop.time())

    def gone(self, client: Hashable) -> None:
        """The connection of the client is closed."""
        servos = self.leases.gone(client)
        label = self._labels.pop(client, "")
        if servos:
            self._lose(label, servos, "its connection is closed")

    def forget_removed(self) -> None:
        """After a reload: servos that are no longer in the config are held by nobody."""
        self.leases.forget(set(self.leases.holders()) - set(self._rig.names))

    async def close(self) -> None:
        self._timer.cancel()
        await asyncio.gather(*self._stopping)

    def _watch(self) -> None:
        expiry = self.leases.next_expiry()
        if expiry is not None:
            self._timer.by(expiry)

    def _expire(self) -> None:
        for client, servos in self.leases.expire(self._loop.time()).items():
            self._lose(self._labels.get(client, ""), servos, "it did not renew its lease in time")
        self._watch()

    def _lose(self, label: str, servos: set[str], reason: str) -> None:
        present = servos & set(self._rig.names)
        self.leases.block(present, STOPPING)
        fields = {"client": label, "servos": sorted(servos), "reason": reason}
        log.warning("lease_lost", **fields)
        self._rig.event_source.publish(Event(EventName.LEASE_LOST, self._loop.time(), fields))
        task = asyncio.create_task(self._stop(present))
        self._stopping.add(task)
        task.add_done_callback(self._stopping.discard)

    async def _stop(self, servos: set[str]) -> None:
        try:
            reports = await self._rig.abandon(servos)
            if doubtful := {name: report.detail for name, report in reports.items() if not report.confirmed}:
                log.warning("lost_client_unconfirmed", servos=doubtful)
        finally:
            self.leases.unblock(servos)
