"""BusMaster: the asyncio shell around the engine of one line.

It moves bytes between a transport and the engine, and wakes the engine in time. Everything is decided by the pure
`Engine`: what is transmitted, what the bytes mean, when a reply counts as missed. The hot path is one callback:
`data_received` ends a turn and writes the next frame, without a task switch and without a timer of its own. One lazily
re-armed deadline timer and one wake timer serve the whole bus.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import cast

from servobus.engine.engine import Engine, WaitUntil
from servobus.engine.job import Job
from servobus.engine.turn import Transmit
from servobus.links.base import Transport
from servobus.timers import CoarseTimer, FineTimer, clock_of

CLOSE_TIMEOUT = 0.5
"""Seconds for the last bytes to leave."""
SECOND_POLL = 0.001
"""Seconds by which a deadline is moved, once, on links whose input cannot be polled: one more pass of the loop."""


class BusMaster(asyncio.Protocol):
    """Owns the line. Callers hand in jobs and hold futures; nothing they do or fail to do tears a turn."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self.trace: Callable[[bool, bytes, float], None] | None = None
        """Called with (sent, bytes, time) for everything on the wire."""
        self._loop = asyncio.get_running_loop()
        self._clock = clock_of(self._loop)
        self._transport: Transport | None = None
        self._closed: asyncio.Future[None] = self._loop.create_future()
        self._deadline = CoarseTimer(self._loop, self._on_deadline)
        self._wake = FineTimer(self._loop, self._on_wake)
        self._wake_due = False
        engine.scheduler.wanted = self._on_wanted

    def __repr__(self) -> str:
        return repr(self.engine)

    # Callers

    @property
    def up(self) -> bool:
        return self.engine.up

    def submit(self, job: Job) -> None:
        """Queue a request or a plan. Raises LinkDown, Overloaded."""
        now = self._clock()
        if self.engine.submit(job, now):
            self._pump(now)

    def submit_stop(self, job: Job) -> None:
        """Put a stop before all that waits; an e-stop also drops what moves. Raises LinkDown."""
        self.engine.submit_stop(job)
        self._pump(self._clock())

    def set_baudrate(self, baudrate: int) -> None:
        """Change the rate between the turns of an exclusive session."""
        if self._transport is not None:
            self._transport.set_baudrate(baudrate)
            self.engine.baudrate_changed(baudrate, self._clock())

    async def wait_closed(self) -> None:
        """Wait until the line is gone."""
        await asyncio.shield(self._closed)

    async def close(self) -> None:
        """Leave the line for good, when what was written has left it; everything that waits ends with LinkDown."""
        transport = self._transport
        if transport is not None:
            transport.close()
            try:
                async with asyncio.timeout(CLOSE_TIMEOUT):
                    await self.wait_closed()
            except TimeoutError:
                transport.abort()
        self._wake.close()

    # The line

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("Transport", transport)
        self._closed = self._loop.create_future()
        now = self._clock()
        self.engine.opened(now)
        self._pump(now)

    def connection_lost(self, exc: Exception | None) -> None:
        self._transport = None
        self._wake.cancel()
        self.engine.lost(exc)
        if not self._closed.done():
            self._closed.set_result(None)

    def data_received(self, data: bytes) -> None:
        now = self._clock()
        if self.trace is not None:
            self.trace(False, data, now)
        self.engine.receive(data, now)
        self._pump(now)

    def _pump(self, now: float) -> None:
        """Write what may be written now, and set the timer for what may be written later."""
        engine, transport = self.engine, self._transport
        if transport is None:
            return
        while isinstance(action := engine.next_action(now), Transmit):
            if self.trace is not None:
                self.trace(True, action.frame, now)
            transport.write(action.frame)
            if action.deadline is not None and action.deadline < self._deadline.at:
                self._deadline.by(action.deadline)
        if isinstance(action, WaitUntil):
            self._wake.by(action.when)

    # Time

    def _on_wanted(self) -> None:
        """Pump after this pass of the loop, so that all goals put in it leave together."""
        if not self._wake_due and self.engine.takes_frames:
            self._wake_due = True
            self._loop.call_soon(self._on_wake)

    def _on_wake(self) -> None:
        self._wake_due = False
        self._pump(self._clock())

    def _on_deadline(self) -> None:
        """End a turn whose deadline has passed. The timer is not moved at each turn, so it may be early for the present one."""
        engine, transport = self.engine, self._transport
        if transport is None or engine.deadline is None:
            return
        if self._clock() >= engine.deadline and not transport.poll_input():
            engine.extend(self._clock() + SECOND_POLL)  # bytes that arrived and were not read yet are not late
        now = self._clock()
        engine.timed_out(now)
        self._pump(now)
        if engine.deadline is not None:
            self._deadline.by(engine.deadline)
