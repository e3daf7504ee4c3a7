"""How long the daemon's loop stood still: stopped by a signal, suspended with the machine, or held up by a callback.

What is read after that may have waited for as long. A call that does not say when it was made is taken to be that old.
"""

from __future__ import annotations

import asyncio

from servobus.timers import clock_of

PERIOD = 0.05  # seconds between two ticks


class StandStill:
    """Reads the clock every `PERIOD`, until `close`."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._now = clock_of(loop)
        self._ticked_at = self._now()
        self._late = 0.0  # how late the last tick was
        self._timer = loop.call_later(PERIOD, self._tick)

    def _tick(self) -> None:
        now = self._now()
        self._late, self._ticked_at = max(0.0, now - self._ticked_at - PERIOD), now
        self._timer = self._loop.call_later(PERIOD, self._tick)

    def earliest(self) -> float:
        """Return since when what is read now may have waited: now, less the time in which the loop stood still."""
        return min(self._now() - self._late, self._ticked_at + PERIOD)

    def close(self) -> None:
        self._timer.cancel()
