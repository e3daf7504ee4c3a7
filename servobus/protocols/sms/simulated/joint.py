"""A simulated joint: where it is at a time one names. Nothing runs between two questions; `advance` catches up.

It speeds up and stops at once (acceleration is not simulated), knows no gravity, and warms up with its load.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

AMBIENT = 25.0
RISE = 40.0
"""Degrees above ambient that full load ends at."""
THERMAL_S = 100.0
"""Seconds after which 63 % of the way to that are done."""


@dataclass(slots=True)
class Joint:
    """Positions in steps, as the servo reports them; rates in steps/s."""

    turn: int
    """Steps per turn."""
    fastest: float
    position: float
    target: float
    rate: float = 0.0
    """On the way to the target; signed where it turns as a wheel."""
    driven: bool = False
    wheel: bool = False
    wraps: bool = True
    """After one turn it reports 0 again; False: it counts turns."""
    stuck: bool = False
    """For tests: something holds it where it is."""
    temperature: float = AMBIENT
    at: float = -math.inf

    def advance(self, now: float) -> None:
        """Be where it is at `now`; a time that has passed already changes nothing."""
        elapsed = now - self.at
        if elapsed <= 0:
            return
        self.at = now
        if elapsed == math.inf:
            return  # the first time it is told the time
        load = self.load
        way = self.velocity * elapsed
        busy = elapsed if load else 0.0
        if self.wheel:
            self.position += way
        elif way:
            left = self.target - self.position
            busy = elapsed * min(1.0, left / way)
            self.position = self.target if abs(left) <= abs(way) else self.position + way
        if self.wraps:
            self.position %= self.turn
        self._warm(busy, abs(load))
        self._warm(elapsed - busy, 0.0)

    @property
    def velocity(self) -> float:
        return 0.0 if self.stuck else self._wanted

    @property
    def load(self) -> float:
        """-1 to 1: with its speed while it moves, all of it where it cannot."""
        wanted = self._wanted
        return math.copysign(1.0, wanted) if self.stuck and wanted else wanted / self.fastest

    @property
    def _wanted(self) -> float:
        if not self.driven:
            return 0.0
        if self.wheel:
            return self.rate
        left = self.target - self.position
        return math.copysign(self.rate, left) if left else 0.0

    def _warm(self, seconds: float, load: float) -> None:
        end = AMBIENT + RISE * load
        if seconds and self.temperature != end:
            self.temperature = end + (self.temperature - end) * math.exp(-seconds / THERMAL_S)
