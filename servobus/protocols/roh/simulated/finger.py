"""The fingers of a simulated ROH hand: motion at a finite speed, and what happens when something is in the way.

Where the documents are silent it does this: a blocked finger draws its current limit and says over_current until the stop-after
period has passed, then it says stuck and draws nothing; where force is measured, force is 10 mN for each mA, and a finger whose
force limit, or force target, is below that says force_reached and holds there. What blocks stands in the way of closing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from servobus.protocols.roh.model import FULL

OPENING, CLOSING, REACHED, OVER_CURRENT, FORCE_REACHED, STUCK = range(6)
MOVING_CURRENT = 150
"""Milliampere."""
GRIP = 10
"""Millinewton for each milliampere."""


@dataclass(slots=True)
class SimulatedFinger:
    """One finger, in logical positions. `obstacle` may be set at any time."""

    position: float = 0.0
    target: int = 0
    speed: int = FULL
    """Positions/s."""
    current_limit: int = 1178
    """mA."""
    force_limit: int | None = None
    """mN; None: no limit."""
    stop_after: float = 0.3
    """Seconds against an obstacle."""
    obstacle: float | None = None
    """It cannot close beyond."""
    status: int = REACHED
    current: int = 0
    force: int = 0
    blocked: float = 0.0
    """Seconds it has been pushing."""

    def advance(self, elapsed: float) -> None:
        """Be where it is after so many seconds."""
        left = self.target - self.position
        way = self.speed * elapsed
        goal = float(self.target) if abs(left) <= way else self.position + math.copysign(way, left)
        end = goal if self.obstacle is None else min(goal, max(self.obstacle, min(self.position, goal)))
        if end < goal:
            used = (end - self.position) / self.speed if self.speed else elapsed
            self.position = end
            self._push(elapsed - used)
            return
        self.position, self.blocked, self.force = goal, 0.0, 0
        if goal == self.target:
            self.status, self.current = REACHED, 0
        else:
            self.status, self.current = (CLOSING if left > 0 else OPENING), MOVING_CURRENT

    def _push(self, elapsed: float) -> None:
        self.blocked += elapsed
        self.force = GRIP * self.current_limit
        if self.force_limit is not None and self.force_limit < self.force:
            self.status, self.force = FORCE_REACHED, self.force_limit
            self.current = self.force // GRIP
        elif self.blocked <= self.stop_after:
            self.status, self.current = OVER_CURRENT, self.current_limit
        else:
            self.status, self.current, self.force = STUCK, 0, 0
