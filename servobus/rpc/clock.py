"""How old a call is, by the clock of its caller: a goal that waited on its way must not be sent late.

A call may say when it was made (`asked`), in seconds of its caller's monotonic clock. Processes of one machine share that clock.
That of another machine differs by an offset, and drifts slowly. The smallest difference that was seen is the offset and the
shortest way; what a call has more than that is its age.
"""

from __future__ import annotations

import functools
import math
from pathlib import Path

BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
DRIFT = 100e-6  # seconds that two clocks may drift apart in each second


@functools.cache
def machine() -> str:
    """Names the machine since its last start, and with it the clock; empty: the system does not tell."""
    try:
        return BOOT_ID.read_text().strip()
    except OSError:
        return ""


class CallerClock:
    """The clock of one client. Pure: `now` is the time of this process."""

    def __init__(self) -> None:
        self._shared = False
        self._smallest = math.inf
        self._smallest_at = 0.0

    def greet(self, name: str) -> None:
        """The client says on which machine it is (`machine`); empty: it does not say."""
        self._shared = bool(name) and name == machine()

    def age(self, asked: float | None, now: float) -> float:
        """Return the seconds since a call was made at `asked`; 0 where the caller does not say when."""
        if asked is None:
            return 0.0
        difference = now - asked
        if self._shared:
            return max(0.0, difference)
        offset = self._smallest + DRIFT * (now - self._smallest_at)
        if not difference > offset:
            self._smallest, self._smallest_at = difference, now
            return 0.0
        return difference - offset
