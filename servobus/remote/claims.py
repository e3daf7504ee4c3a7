"""What a client believes to hold of the motion leases, so that only a fresh wish takes back what was lost. The time is given.

The daemon decides; this errs to the safe side, since it counts from when it spoke, and the daemon from when it heard.
"""

from __future__ import annotations

from collections.abc import Collection


class HeldLeases:
    """By full servo name."""

    def __init__(self) -> None:
        self.ttl = 0.5
        """Seconds, as the daemon says."""
        self.held: set[str] = set()
        self._until = 0.0
        self._lost: set[str] = set()

    def to_acquire(self, servos: Collection[str], now: float) -> set[str]:
        """Of these, what has to be acquired in so many words before it may move."""
        if self.held and now >= self._until:
            self._lost |= self.held
            self.held = set()
        return self._lost.intersection(servos)

    def taken(self, servos: Collection[str], asked: float) -> None:
        """By moving or acquiring, asked for at that time."""
        self.held.update(servos)
        self._lost.difference_update(servos)
        self._until = max(self._until, asked + self.ttl)

    def renewed(self, servos: Collection[str], asked: float) -> None:
        """What the daemon says we hold."""
        self._lost |= self.held.difference(servos)
        self.held = set(servos)
        self._until = asked + self.ttl

    def refused(self, servos: Collection[str]) -> None:
        """LeaseHeld: what was wished then is void, so the next wish has to say so."""
        self.held.difference_update(servos)
        self._lost.update(servos)

    def released(self, servos: Collection[str]) -> None:
        self.held.difference_update(servos)
        self._lost.difference_update(servos)

    def clear(self) -> None:
        """Another connection is another client: it holds nothing, and has lost nothing."""
        self.held.clear()
        self._lost.clear()
