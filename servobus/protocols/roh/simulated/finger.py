"""A finger of a simulated ROH hand: it moves at a finite speed, and an obstacle may block it.

Where the documents are silent: a blocked finger draws its current limit and reports over_current until the stop-after period has
passed; then it reports stuck and draws nothing. Its force is 10 mN for each mA. A finger whose force limit or force target is
below that reports force_reached and holds. An obstacle blocks closing only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from servobus.protocols.roh.model import FULL

TO_OPEN, TO_CLOSED, REACHED, OVER_CURRENT, FORCE_REACHED, STUCK = range(6)
MOVING_CURRENT = 150
"""mA."""
GRIP = 10
"""mN for each mA."""


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
    """The position beyond which it cannot close."""
    status: int = REACHED
    current: int = 0
    force: int = 0
    blocked: float = 0.0
    """Seconds it has been pushing against it."""

    def advance(self, elapsed: float) -> None:
        """Move on by so many seconds."""
        left = self.target - self.position
        step = self.speed * elapsed
        goal = float(self.target) if abs(left) <= step else self.position + math.copysign(step, left)
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
            self.status, self.current = (TO_CLOSED if left > 0 else TO_OPEN), MOVING_CURRENT

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
