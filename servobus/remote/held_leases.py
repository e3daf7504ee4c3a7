"""Which motion leases a client holds, as far as it knows. A lost lease is only taken back for a new motion. Pure: `now` is given.

The daemon decides. This errs to the safe side: it counts from the time of sending, the daemon from the time of receiving.
"""

from __future__ import annotations

from collections.abc import Collection


class HeldLeases:
    """Servos by full name."""

    def __init__(self) -> None:
        self.ttl = 0.5  # seconds that a lease lasts; the daemon says how long
        self.held: set[str] = set()
        self._until = 0.0
        self._lost: set[str] = set()

    def to_acquire(self, servos: Collection[str], now: float) -> set[str]:
        """Those of `servos` that were lost, and must be acquired before they may move."""
        if self.held and now >= self._until:
            self._lost |= self.held
            self.held = set()
        return self._lost.intersection(servos)

    def taken(self, servos: Collection[str], asked: float) -> None:
        """The client moved or acquired `servos`; `asked` is the time of sending."""
        self.held.update(servos)
        self._lost.difference_update(servos)
        self._until = max(self._until, asked + self.ttl)

    def renewed(self, servos: Collection[str], asked: float) -> None:
        """The daemon says that the client holds `servos`."""
        self._lost |= self.held.difference(servos)
        self.held = set(servos)
        self._until = asked + self.ttl

    def refused(self, servos: Collection[str]) -> None:
        """The daemon refused a motion (LeaseHeld): the next one must acquire first."""
        self.held.difference_update(servos)
        self._lost.update(servos)

    def released(self, servos: Collection[str]) -> None:
        """The client gave `servos` back."""
        self.held.difference_update(servos)
        self._lost.difference_update(servos)

    def clear(self) -> None:
        """A new connection is a new client: it holds nothing and has lost nothing."""
        self.held.clear()
        self._lost.clear()
