"""Whether the buses go on. The system's watchdog is fed by that, never by a timer alone: a daemon whose loop runs while a line
stands still must be started anew."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Pulse:
    """One bus at one look."""

    up: bool
    """The line is open."""
    frames: int
    """Said so far."""
    heard: int
    """Bytes heard so far."""
    waiting: int
    """What wants to be said."""


class Watchdog:
    """Pure: looks at pulses, one look after another."""

    def __init__(self) -> None:
        self._last: Mapping[str, Pulse] = {}

    def stuck(self, pulses: Mapping[str, Pulse]) -> list[str]:
        """The buses that had something to say at this look and at the last, and neither said nor heard anything between."""
        last, self._last = self._last, dict(pulses)
        return [name for name, pulse in pulses.items() if name in last and self._is_stuck(last[name], pulse)]

    @staticmethod
    def _is_stuck(before: Pulse, now: Pulse) -> bool:
        wanted = before.up and now.up and before.waiting and now.waiting
        return bool(wanted) and (before.frames, before.heard) == (now.frames, now.heard)
