"""A client's side of the motion leases: taken by moving, renewed while any is held, acquired again after a loss."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection
from contextlib import suppress
from typing import Any

from servobus.errors import LeaseHeld, LinkDown, ReplyTimeout, ServobusError
from servobus.remote.held_leases import HeldLeases
from servobus.remote.session import Session

RELEASE_TIMEOUT = 1.0  # seconds that leaving waits for the daemon


class ClientLeases:
    """The leases of one client. Servos by full name."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._held = HeldLeases()
        self._clock = asyncio.get_running_loop().time
        self._moving = 0  # motion calls under way
        self._renewing: asyncio.Task[None] | None = None

    def begin(self, ttl: float) -> None:
        """A new connection: `ttl` is how long its leases last, in seconds."""
        self._held.clear()
        self._held.ttl = ttl

    async def move(
        self, method: str, servos: Collection[str], params: dict[str, Any], then: Callable[[Any], Any] | None = None
    ) -> Any:
        """Call a method that moves. Leases that were lost since the last motion are acquired first."""
        if lost := self._held.to_acquire(servos, self._clock()):
            await self.acquire(lost)
        self._renew_from_now()
        self._moving += 1
        asked = self._clock()
        try:
            result = await self._session.call(method, params, then=then)
        except LeaseHeld:
            self._held.refused(servos)
            raise
        finally:
            self._moving -= 1
        self._held.taken(servos, asked)
        return result

    async def acquire(self, servos: Collection[str]) -> None:
        asked = self._clock()
        await self._session.call("acquire", {"names": sorted(servos)})
        self._held.taken(servos, asked)
        self._renew_from_now()

    async def release(self, servos: Collection[str]) -> None:
        await self._session.call("release", {"names": sorted(servos)})
        self._held.released(servos)

    def _renew_from_now(self) -> None:
        if self._renewing is None or self._renewing.done():
            self._renewing = asyncio.create_task(self._renew())

    async def _renew(self) -> None:
        """Renew three times within the life of a lease, as long as one is held or a motion is under way."""
        while True:
            await asyncio.sleep(self._held.ttl / 3)
            asked = self._clock()
            try:
                lease = await self._session.call("renew", {}, timeout=self._held.ttl)
            except ReplyTimeout:
                continue
            except ServobusError:
                return
            self._held.renewed(lease.names, asked)
            if not (lease.names or self._moving):
                return

    async def end(self, *, lost: bool) -> None:
        """Give all leases back, unless this client is `lost`."""
        if self._renewing is None:
            return
        self._renewing.cancel()
        if not lost:
            with suppress(LinkDown, ReplyTimeout):  # the daemon is gone, and the leases with it
                await self._session.call("release", {}, timeout=RELEASE_TIMEOUT)
