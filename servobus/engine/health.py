"""What is believed of each node: online, doubtful or offline, how soon it answers, and when to look for it again.
Pure.

A node is doubtful from the moment an answer is missing, because that answer may still come and be taken for the next
one; it stays so until a fence was answered. After a few misses in a row it is offline: nobody waits for it, and it is
probed ever more seldom.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable
from enum import StrEnum

FIRST_DEADLINE = 0.020
"""Seconds allowed to a node nobody has heard yet, beyond the wire time."""
MIN_DEADLINE = 0.005
"""A host is not punctual: below this a busy machine would look like a silent servo."""
MAX_DEADLINE = 0.100
OFFLINE_AFTER = 3
"""Misses in a row."""
FIRST_BACKOFF = 0.050
MAX_BACKOFF = 3.2
MAX_OUTSTANDING = 64


class Condition(StrEnum):
    ONLINE = "online"
    DOUBTFUL = "doubtful"
    OFFLINE = "offline"


class Node:
    """One node: health, the learned deadline, and the replies that may still be under way."""

    __slots__ = (
        "_deadline",
        "_mean",
        "_spread",
        "backoff",
        "condition",
        "configured",
        "enabled",
        "greatest_deadline",
        "id",
        "misses",
        "next_probe",
        "outstanding",
        "status",
    )

    def __init__(self, node_id: int, *, configured: bool, greatest_deadline: float) -> None:
        self.id = node_id
        self.configured = configured
        self.greatest_deadline = greatest_deadline
        self.condition = Condition.DOUBTFUL
        self.enabled: tuple[str, ...] = ()
        """Its servos that we have enabled, so a restart matters."""
        self.status: int | None = None
        self.outstanding: dict[Hashable, float] = {}
        """Look of a reply that did not come -> when it was asked for, oldest first."""
        self.misses = 0
        self.backoff = 0.0
        self.next_probe = 0.0
        self._mean: float | None = None
        self._spread = 0.0
        self._deadline = min(FIRST_DEADLINE, greatest_deadline)

    @property
    def deadline(self) -> float:
        """Seconds allowed to its reply beyond the wire time."""
        return self._deadline

    def learn(self, latency: float) -> None:
        """A retransmission timer as TCP keeps it: smoothed mean and four times the spread."""
        latency = max(latency, 0.0)
        if self._mean is None:
            self._mean, self._spread = latency, latency / 2
        else:
            error = latency - self._mean
            self._mean += error / 8
            self._spread += (abs(error) - self._spread) / 4
        wanted = self._mean + 4 * self._spread
        self._deadline = min(max(wanted, MIN_DEADLINE), self.greatest_deadline)

    def answered(self, status: int | None) -> None:
        """It gave an answer that was believed."""
        self.status = status
        self.misses = 0

    def doubt(self, key: Hashable, asked_at: float) -> None:
        """A reply of this look may still come, or came once too often."""
        self.outstanding.pop(key, None)
        self.outstanding[key] = asked_at
        if len(self.outstanding) > MAX_OUTSTANDING:
            del self.outstanding[next(iter(self.outstanding))]
        if self.condition is Condition.ONLINE:
            self.condition = Condition.DOUBTFUL
            self.next_probe = asked_at

    def missed(self, key: Hashable, asked_at: float, now: float) -> None:
        """No answer within the deadline."""
        self.doubt(key, asked_at)
        self.misses += 1
        if self.misses < OFFLINE_AFTER:
            self._deadline = min(2 * self._deadline, self.greatest_deadline)
            self.next_probe = now
            return
        self.condition = Condition.OFFLINE
        self._deadline = min(FIRST_DEADLINE, self.greatest_deadline)
        self.backoff = min(2 * self.backoff, MAX_BACKOFF) if self.backoff else FIRST_BACKOFF
        self.next_probe = now + self.backoff

    def late(self, key: Hashable, now: float) -> None:
        """A reply came after it was given up: how long it took is worth knowing."""
        asked_at = self.outstanding.get(key)
        if asked_at is not None:
            self.learn(now - asked_at)
            if self.condition is Condition.OFFLINE:
                self.next_probe = now

    def recovered(self) -> None:
        """A fence was answered: every older reply has come and gone."""
        self.outstanding.clear()
        self.condition = Condition.ONLINE
        self.misses = 0
        self.backoff = 0.0

    def suspect(self) -> None:
        """After the line was gone: ask before believing."""
        if self.condition is Condition.ONLINE:
            self.condition = Condition.DOUBTFUL
        self.next_probe = 0.0
        self.backoff = 0.0


class Health:
    """The nodes of one bus. `changed(node, before)` is told of every change of condition."""

    def __init__(
        self, nodes: Collection[int], *, greatest_deadline: float = MAX_DEADLINE, changed: Callable[[Node, Condition], None]
    ) -> None:
        self._greatest_deadline = greatest_deadline
        self._changed = changed
        self.nodes: dict[int, Node] = {}
        self.troubled: dict[int, Node] = {}
        """Configured nodes that are not online."""
        for node_id in nodes:
            self._add(node_id, configured=True)

    def node(self, node_id: int) -> Node:
        """The node of that id; one nobody configured is kept too, but never probed."""
        return self.nodes.get(node_id) or self._add(node_id, configured=False)

    def missed(self, node: Node, key: Hashable, asked_at: float, now: float) -> None:
        before = node.condition
        node.missed(key, asked_at, now)
        self._report(node, before)

    def doubt(self, node: Node, key: Hashable, now: float) -> None:
        before = node.condition
        node.doubt(key, now)
        self._report(node, before)

    def recovered(self, node: Node) -> None:
        before = node.condition
        node.recovered()
        self._report(node, before)

    def suspect_all(self) -> None:
        """The line was gone."""
        for node in self.nodes.values():
            before = node.condition
            node.suspect()
            self._report(node, before)

    def reachable(self) -> list[int]:
        """Configured nodes that may be asked in a group: the others are asked alone, after a fence."""
        return [node.id for node in self.nodes.values() if node.condition is Condition.ONLINE]

    def due_probe(self, now: float) -> Node | None:
        """The configured node that has waited longest to be looked for."""
        if not self.troubled:
            return None
        due = [node for node in self.troubled.values() if node.next_probe <= now]
        return min(due, key=lambda node: node.next_probe, default=None)

    def next_probe(self) -> float | None:
        """When the next probe is due; None: no node needs one."""
        return min((node.next_probe for node in self.troubled.values()), default=None)

    def _add(self, node_id: int, *, configured: bool) -> Node:
        node = Node(node_id, configured=configured, greatest_deadline=self._greatest_deadline)
        if not configured:
            # Nothing was asked of it yet, so nothing of it can be under way.
            node.condition = Condition.ONLINE
        else:
            self.troubled[node_id] = node
        self.nodes[node_id] = node
        return node

    def _report(self, node: Node, before: Condition) -> None:
        if node.condition is before:
            return
        if node.condition is Condition.ONLINE:
            self.troubled.pop(node.id, None)
        elif node.configured:
            self.troubled[node.id] = node
        self._changed(node, before)
