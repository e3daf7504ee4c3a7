"""Exclusive sessions of one bus, and changes of ids and rates in them."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import TypeVar

from servobus.bus.motion import Motion
from servobus.bus.requests import BusParts, Requests
from servobus.errors import Busy, NotSupported
from servobus.protocols.base import Commissioning, Plan

R = TypeVar("R")


class Sessions:
    """Lends the line to one caller at a time."""

    def __init__(self, parts: BusParts, requests: Requests, motion: Motion) -> None:
        self._parts = parts
        self._requests = requests
        self._motion = motion

    @asynccontextmanager
    async def exclusive(self) -> AsyncIterator[object]:
        """Open a session: polls, probes and goals rest, motion is refused, the requests of others wait.

        Raises Busy while another session is open or a servo is enabled, EStopped while the e-stop is latched.
        """
        self._motion.refuse()
        moving = [name for name, record in self._parts.records.items() if record.enabled or name in self._motion.enabling]
        if moving:
            verb = "is" if len(moving) == 1 else "are"
            raise Busy(f"{', '.join(moving)} {verb} enabled: disable first", bus=self._parts.name)
        session = self._parts.scheduler.open_session()
        try:
            yield session
        finally:
            self._parts.scheduler.close_session()

    async def commission(self, node: int, plan_of: Callable[[Commissioning], Plan[R]]) -> R:
        """Change an id or a rate, or run a maintenance command, alone on the line and with nothing enabled.

        Raises NotSupported, Busy, LimitError, DeviceError.
        """
        commissioning = self._parts.driver.commissioning
        if commissioning is None:
            message = "servos of this bus get their ids and rates with the vendor's tool"
            raise NotSupported(message, bus=self._parts.name)
        plan = plan_of(commissioning)
        async with self.exclusive() as session:
            return await self._requests.perform(plan, node, even_if_offline=True, session=session)

    def set_baudrate(self, baudrate: int) -> None:
        """Change the rate of the line; in an exclusive session."""
        if baudrate != self._parts.line.traits.baudrate:
            self._parts.master.set_baudrate(baudrate)
