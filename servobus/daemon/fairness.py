"""The door's share of the loop: so much in one pass and no more, in turn between connections.

The door and the buses live on one loop. After each share the loop turns once, so that what came from the lines is served first.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from time import perf_counter

BUDGET = 0.001
"""Seconds of one pass."""


class FairShare:
    """Turns are callables that do one piece and return whether there is more."""

    def __init__(self, loop: asyncio.AbstractEventLoop, now: Callable[[], float] = perf_counter) -> None:
        self._loop = loop
        self._now = now
        self._turns: deque[Callable[[], bool]] = deque()
        self._due = False
        self._until: float | None = None
        """When what may be done at once in this pass is used up."""

    def add(self, turn: Callable[[], bool]) -> None:
        self._turns.append(turn)
        if not self._due:
            self._due = True
            self._loop.call_soon(self._run)

    def at_once(self) -> bool:
        """Nobody waits, and of this pass of the loop something is left: a piece may be done without waiting for a share."""
        if self._due:
            return False
        now = self._now()
        if self._until is None:
            self._until = now + BUDGET
            self._loop.call_soon(self._pass_over)
        return now < self._until

    def _pass_over(self) -> None:
        self._until = None

    def _run(self) -> None:
        end = self._now() + BUDGET
        while self._turns:
            turn = self._turns.popleft()
            if turn():
                self._turns.append(turn)
            if self._turns and self._now() >= end:
                self._loop.call_soon(self._run)
                return
        self._due = False


class TokenBucket:
    """Tokens of one client. Pure."""

    def __init__(self, rate: float | None, now: float) -> None:
        self._rate = rate
        self._full = max(1.0, rate or 0.0)  # a second's worth at once
        self._tokens = self._full
        self._at = now

    def take(self, now: float) -> float:
        """Take one; seconds until it may be used, 0: now."""
        if self._rate is None:
            return 0.0
        self._tokens = min(self._full, self._tokens + (now - self._at) * self._rate)
        self._at = now
        self._tokens -= 1
        return max(0.0, -self._tokens / self._rate)
