"""Polls on fixed grids: each is due at every whole period, and a late one does not shift the next. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from servobus.protocols.base import Poll


@dataclass(slots=True)
class PollTimer:
    """When one poll is due next."""

    poll: Poll
    due: float
    missed: int = 0
    """Whole periods that passed without the poll."""

    def advance(self, now: float) -> None:
        period = 1.0 / self.poll.hz
        self.due += period
        if self.due <= now:
            behind = int((now - self.due) / period) + 1
            self.missed += behind
            self.due += behind * period


class PollGrid:
    """All polls of a bus."""

    def __init__(self) -> None:
        self.due = math.inf
        """When the next poll is due; infinite: never."""
        self._timers: list[PollTimer] = []
        self._missed_before = 0

    def set(self, polls: Sequence[Poll], now: float) -> None:
        """Replace the polls. Those of one rate are spread over their period."""
        self._missed_before = self.missed
        self._timers = [PollTimer(poll, now + index / len(polls) / poll.hz) for index, poll in enumerate(polls)]
        self.due = min((timer.due for timer in self._timers), default=math.inf)

    @property
    def missed(self) -> int:
        """Periods that passed without their poll since the start."""
        return self._missed_before + sum(timer.missed for timer in self._timers)

    def take(self, now: float) -> Poll | None:
        """Return the poll that has been due longest."""
        if self.due > now:
            return None
        timer = min(self._timers, key=lambda timer: timer.due)
        timer.advance(now)
        self.due = min(timer.due for timer in self._timers)
        return timer.poll
