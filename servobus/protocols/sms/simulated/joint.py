"""A simulated joint: its position at any given time. Nothing runs between two calls; `advance` computes what happened since.

It reaches its speed and stops at once (acceleration is not simulated), falls while it is limp if it has a `sag`, and warms up
with its load.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

AMBIENT = 25.0
RISE = 40.0
"""Degrees above ambient that full load leads to."""
THERMAL_S = 100.0
"""Seconds after which 63 % of that rise are reached."""


@dataclass(slots=True)
class Joint:
    """Positions in steps, as the servo reports them; rates in steps/s."""

    turn: int
    """Steps per turn."""
    fastest: float
    position: float
    target: float
    rate: float = 0.0
    """Speed towards the target; signed where it turns without one."""
    driven: bool = False
    wheel: bool = False
    """It turns at its rate, without a target."""
    wraps: bool = True
    """It reports 0 again after one turn; False: it counts turns."""
    stuck: bool = False
    """For tests: something blocks it."""
    sag: float = 0.0
    """For tests: steps/s at which gravity moves it while it is limp."""
    temperature: float = AMBIENT
    at: float = -math.inf

    def advance(self, now: float) -> None:
        """Move to where it is at `now`; an earlier time changes nothing."""
        elapsed = now - self.at
        if elapsed <= 0:
            return
        self.at = now
        if elapsed == math.inf:
            return  # this is the first time that is known
        load = self.load
        distance = self.velocity * elapsed
        busy = elapsed if load else 0.0
        if self.wheel or not self.driven:
            self.position += distance
        elif distance:
            left = self.target - self.position
            busy = elapsed * min(1.0, left / distance)
            self.position = self.target if abs(left) <= abs(distance) else self.position + distance
        if self.wraps:
            self.position %= self.turn
        self._warm(busy, abs(load))
        self._warm(elapsed - busy, 0.0)

    @property
    def velocity(self) -> float:
        return 0.0 if self.stuck else self._free_velocity

    @property
    def load(self) -> float:
        """Return -1 to 1: in proportion to the speed while it moves, full load where it is stuck."""
        velocity = self._free_velocity if self.driven else 0.0
        return math.copysign(1.0, velocity) if self.stuck and velocity else velocity / self.fastest

    @property
    def _free_velocity(self) -> float:
        if not self.driven:
            return self.sag
        if self.wheel:
            return self.rate
        left = self.target - self.position
        return math.copysign(self.rate, left) if left else 0.0

    def _warm(self, seconds: float, load: float) -> None:
        end = AMBIENT + RISE * load
        if seconds and self.temperature != end:
            self.temperature = end + (self.temperature - end) * math.exp(-seconds / THERMAL_S)
