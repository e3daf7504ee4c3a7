"""Motion leases: which client may move a servo now. Pure: the time is given.

A lease belongs to one connection. It ends when it is not renewed in time, or with the connection; both count as the loss of the
client. A client that lost a lease must acquire it again: a motion that it sent before it knew of the loss is refused.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Iterable, Mapping
from dataclasses import dataclass

from servobus.errors import LeaseHeld


@dataclass(slots=True)
class _Holder:
    label: str  # its name for other clients
    servos: set[str]
    expires: float


class Leases:
    """Clients are any hashable objects, servos are full names, times are seconds."""

    def __init__(self, ttl: float) -> None:
        self.ttl = ttl  # seconds
        self._holders: dict[Hashable, _Holder] = {}
        self._owner: dict[str, Hashable] = {}
        self._lost: dict[Hashable, set[str]] = {}
        self._blocked: dict[str, str] = {}
        self._count = 0
        self._taken: dict[str, int] = {}  # servo -> number of the call that acquired it last

    def holders(self) -> dict[str, str]:
        """Servo -> label of the client that holds it."""
        return {servo: self._holders[client].label for servo, client in self._owner.items()}

    def check(self, client: Hashable, servos: Iterable[str]) -> None:
        """Refuse servos that another client holds. Raises LeaseHeld."""
        for servo in servos:
            if servo in self._blocked:
                raise LeaseHeld(self._blocked[servo], servo=servo)
            owner = self._owner.get(servo, client)
            if owner != client:
                label = self._holders[owner].label
                raise LeaseHeld(f"{label} moves it: wait until it is released; `stop` is always free", servo=servo)

    def acquire(self, client: Hashable, label: str, servos: Collection[str], now: float) -> set[str]:
        """Take servos on request, all or none, and return all that the client holds. Raises LeaseHeld."""
        self.check(client, servos)
        self._lost.get(client, set()).difference_update(servos)
        holder = self._holders.setdefault(client, _Holder(label, set(), now))
        holder.servos.update(servos)
        holder.expires = now + self.ttl
        self._owner.update(dict.fromkeys(servos, client))
        self._count += 1
        self._taken.update(dict.fromkeys(servos, self._count))
        return set(holder.servos)

    def take(self, client: Hashable, label: str, servos: Collection[str], now: float) -> dict[str, int]:
        """Take servos by moving them. Raises LeaseHeld, also for one that this client lost and did not acquire again.

        Returns what it did not hold before, for `give_back`.
        """
        if lost := self._lost.get(client, set()).intersection(servos):
            raise LeaseHeld("its motion lease has expired, so this may be an old motion: acquire it again", servo=sorted(lost)[0])
        fresh = [servo for servo in servos if servo not in self._owner]
        self.acquire(client, label, servos, now)
        return dict.fromkeys(fresh, self._count)

    def give_back(self, client: Hashable, taken: Mapping[str, int]) -> None:
        """Release what a refused motion has taken, unless the client has moved or acquired it since."""
        self.release(client, {servo for servo, count in taken.items() if self._taken[servo] == count})

    def renew(self, client: Hashable, now: float) -> set[str]:
        """Prolong what the client holds by `ttl`, and return it."""
        holder = self._holders.get(client)
        if holder is None:
            return set()
        holder.expires = now + self.ttl
        return set(holder.servos)

    def release(self, client: Hashable, servos: Collection[str]) -> None:
        """Give servos back; motion goes on to its end. A servo that the client does not hold is no error."""
        holder = self._holders.get(client)
        if holder is not None:
            self._give_up(client, holder, holder.servos.intersection(servos))

    def gone(self, client: Hashable) -> set[str]:
        """The connection is closed. Returns what the client still held."""
        self._lost.pop(client, None)
        holder = self._holders.get(client)
        return self._give_up(client, holder, set(holder.servos)) if holder else set()

    def expire(self, now: float) -> dict[Hashable, set[str]]:
        """End the leases that were not renewed in time. Returns what each client lost."""
        lost = {}
        for client, holder in list(self._holders.items()):
            if holder.expires <= now:
                lost[client] = self._give_up(client, holder, set(holder.servos))
                self._lost.setdefault(client, set()).update(lost[client])
        return lost

    def next_expiry(self) -> float | None:
        return min((holder.expires for holder in self._holders.values()), default=None)

    def block(self, servos: Iterable[str], reason: str) -> None:
        """Refuse these servos to everybody until `unblock`, because they are being stopped or parked."""
        self._blocked.update(dict.fromkeys(servos, reason))

    def unblock(self, servos: Iterable[str]) -> None:
        for servo in servos:
            self._blocked.pop(servo, None)

    def forget(self, servos: Iterable[str]) -> None:
        """Servos that are not in the config any more."""
        for servo in servos:
            client = self._owner.get(servo)
            if client is not None:
                self._give_up(client, self._holders[client], {servo})

    def _give_up(self, client: Hashable, holder: _Holder, servos: set[str]) -> set[str]:
        holder.servos -= servos
        for servo in servos:
            self._owner.pop(servo, None)
        if not holder.servos:
            self._holders.pop(client, None)
        return servos
