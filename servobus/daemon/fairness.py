"""The clients' share of the event loop: a limited time in each pass, divided between connections in turn.

Clients and buses live on one loop. After each share the loop makes a pass, so that bytes from the lines are served first.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from time import perf_counter

BUDGET = 0.001  # seconds of each pass that clients may use


class FairShare:
    """A piece of work is a callable that does one step and returns whether there is more."""

    def __init__(self, loop: asyncio.AbstractEventLoop, now: Callable[[], float] = perf_counter) -> None:
        self._loop = loop
        self._now = now
        self._pieces: deque[Callable[[], bool]] = deque()
        self._due = False
        self._until: float | None = None  # when the share of this pass is used up

    def add(self, piece: Callable[[], bool]) -> None:
        self._pieces.append(piece)
        if not self._due:
            self._due = True
            self._loop.call_soon(self._run)

    def at_once(self) -> bool:
        """Whether a step may be done now: nothing waits, and the share of this pass is not used up."""
        if self._due:
            return False
        now = self._now()
        if self._until is None:
            self._until = now + BUDGET
            self._loop.call_soon(self._end_pass)
        return now < self._until

    def _end_pass(self) -> None:
        self._until = None

    def _run(self) -> None:
        end = self._now() + BUDGET
        while self._pieces:
            piece = self._pieces.popleft()
            if piece():
                self._pieces.append(piece)
            if self._pieces and self._now() >= end:
                self._loop.call_soon(self._run)
                return
        self._due = False


class TokenBucket:
    """Limits the rate of one client: one token a call. Pure."""

    def __init__(self, rate: float | None, now: float) -> None:
        self._rate = rate
        self._full = max(1.0, rate or 0.0)  # a second's worth may be used at once
        self._tokens = self._full
        self._at = now

    def take(self, now: float) -> float:
        """Take a token. Returns the seconds until it may be used; 0: now."""
        if self._rate is None:
            return 0.0
        self._tokens = min(self._full, self._tokens + (now - self._at) * self._rate)
        self._at = now
        self._tokens -= 1
        return max(0.0, -self._tokens / self._rate)
