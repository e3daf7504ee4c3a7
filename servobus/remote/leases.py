"""A client's side of the motion leases: taken by moving, renewed while anything is held, acquired anew for a fresh wish."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection
from contextlib import suppress
from typing import Any

from servobus.errors import LeaseHeld, LinkDown, ReplyTimeout, ServobusError
from servobus.remote.claims import HeldLeases
from servobus.remote.session import Session

RELEASE_TIMEOUT = 1.0
"""Seconds that leaving waits for the daemon."""


class ClientLeases:
    """Servos by full name."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._held = HeldLeases()
        self._clock = asyncio.get_running_loop().time
        self._moving = 0
        """Motion calls under way."""
        self._renewing: asyncio.Task[None] | None = None

    def begin(self, ttl: float) -> None:
        """With a new connection."""
        self._held.clear()
        self._held.ttl = ttl

    async def move(
        self, method: str, servos: Collection[str], params: dict[str, Any], then: Callable[[Any], Any] | None = None
    ) -> Any:
        """A wish of this moment: what was lost since the last one is acquired for it in so many words."""
        if anew := self._held.to_acquire(servos, self._clock()):
            await self.acquire(anew)
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
        """Three times in a lease, as long as anything is held or about to be."""
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
        """Give all of it back, unless this client is `lost`."""
        if self._renewing is None:
            return
        self._renewing.cancel()
        if not lost:
            with suppress(LinkDown, ReplyTimeout):  # there is nobody left to give it back to
                await self._session.call("release", {}, timeout=RELEASE_TIMEOUT)
