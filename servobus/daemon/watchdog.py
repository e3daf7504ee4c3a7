"""Whether every bus makes progress. Only then the system's watchdog is fed: a daemon whose loop runs while a line
is stuck must be started again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Pulse:
    """The counters of one bus at one moment."""

    up: bool  # the line is open
    frames: int  # frames sent so far
    received: int  # bytes received so far
    waiting: int  # jobs that wait


class Watchdog:
    """Compares the pulses of one moment with those of the last. Pure."""

    def __init__(self) -> None:
        self._last: Mapping[str, Pulse] = {}

    def stuck(self, pulses: Mapping[str, Pulse]) -> list[str]:
        """The buses that had jobs at both moments and neither sent nor received anything between."""
        last, self._last = self._last, dict(pulses)
        return [name for name, pulse in pulses.items() if name in last and self._is_stuck(last[name], pulse)]

    @staticmethod
    def _is_stuck(before: Pulse, now: Pulse) -> bool:
        wanted = before.up and now.up and before.waiting and now.waiting
        return bool(wanted) and (before.frames, before.received) == (now.frames, now.received)
