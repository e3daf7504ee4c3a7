"""What is believed of each node: online, doubtful or offline, how soon it replies, and when it is probed next. Pure.

A node becomes doubtful when a reply is missing, because that reply may still come and be taken for the next one. It
stays doubtful until it has answered a fence. After a few misses in a row it is offline: nobody waits for it, and its
probes back off exponentially.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable

from servobus.engine.stats import Cause
from servobus.values import Health

FIRST_ALLOWANCE = 0.020
"""Seconds, beyond the wire time, in which a node that never replied yet may reply."""
MIN_ALLOWANCE = 0.005
"""A host is not punctual: below this a busy machine would look like a silent servo."""
MAX_ALLOWANCE = 0.100
OFFLINE_AFTER = 3
"""Misses in a row."""
FAILING_AFTER = 3
"""Polls in a row that were refused."""
FIRST_BACKOFF = 0.050
MAX_BACKOFF = 3.2
MAX_OWED_BACKOFF = 0.2
"""The same for a node that owes a stop: it is to be stopped as soon as it can be heard."""
MAX_OUTSTANDING = 64

# Looking a member up in its enum is a Python call, and some of these are read in every turn.
ONLINE, DOUBTFUL, FAILING, OFFLINE = Health.ONLINE, Health.DOUBTFUL, Health.FAILING, Health.OFFLINE


class Node:
    """One node: its health, how soon it replies, and the replies that may still be under way."""

    __slots__ = (
        "_first_allowance_s",
        "_mean",
        "_spread",
        "backoff",
        "causes",
        "configured",
        "failing",
        "health",
        "id",
        "max_allowance_s",
        "misses",
        "next_probe",
        "outstanding",
        "owes_stop",
        "refusals",
        "reply_allowance_s",
        "status",
    )

    def __init__(self, node_id: int, *, configured: bool, first_allowance_s: float, max_allowance_s: float) -> None:
        self.id = node_id
        self.configured = configured
        self.max_allowance_s = max_allowance_s
        self.reply_allowance_s = self._first_allowance_s = first_allowance_s
        """Seconds that its reply may take beyond the wire time."""
        self.health = DOUBTFUL
        self.status: int | None = None
        """The newest health byte, where the protocol has one."""
        self.outstanding: dict[Hashable, float] = {}
        """reply_key of each missing reply -> request time, oldest first."""
        self.owes_stop = False
        """A stop of a servo of this node is not confirmed yet."""
        self.refusals = 0
        """Polls in a row that were refused."""
        self.failing = ""
        """Why its polls are refused; empty: they are not."""
        self.causes = dict.fromkeys(Cause, 0)
        """How often a request of it had no value, by cause."""
        self.misses = 0
        self.backoff = 0.0
        self.next_probe = 0.0
        self._mean: float | None = None
        self._spread = 0.0

    def replied(self, status: int | None, latency: float) -> None:
        """Note a reply that was believed, and how long it took beyond the wire time."""
        self.status = status
        self.misses = 0
        self.learn(latency)

    def learn(self, latency: float) -> None:
        """Adapt the allowance as TCP adapts its retransmission timer: smoothed mean plus four times the spread."""
        if latency < 0.0:
            latency = 0.0
        mean = self._mean
        if mean is None:
            self._mean, self._spread = latency, latency / 2
            wanted = 3 * latency
        else:
            error = latency - mean
            self._mean = mean = mean + error / 8
            spread = self._spread
            self._spread = spread = spread + ((error if error >= 0.0 else -error) - spread) / 4
            wanted = mean + 4 * spread
        if wanted < MIN_ALLOWANCE:
            wanted = MIN_ALLOWANCE
        self.reply_allowance_s = wanted if wanted < self.max_allowance_s else self.max_allowance_s

    def answered(self, status: int | None) -> None:
        """Note a reply that was believed; how long it took is not known."""
        self.status = status
        self.misses = 0

    def doubt(self, key: Hashable, asked_at: float) -> None:
        """Note that a reply with this key may still come, or came once too often."""
        self.outstanding.pop(key, None)
        self.outstanding[key] = asked_at
        if len(self.outstanding) > MAX_OUTSTANDING:
            del self.outstanding[next(iter(self.outstanding))]
        if self.health is ONLINE:
            self.health = DOUBTFUL
            self.next_probe = asked_at

    def missed(self, key: Hashable, asked_at: float, now: float) -> None:
        """Note that no reply came within the allowance."""
        self.doubt(key, asked_at)
        self.misses += 1
        if self.misses < OFFLINE_AFTER:
            self.reply_allowance_s = min(2 * self.reply_allowance_s, self.max_allowance_s)
            self.next_probe = now
            return
        self.health = OFFLINE
        self.reply_allowance_s = self._first_allowance_s
        longest = MAX_OWED_BACKOFF if self.owes_stop else MAX_BACKOFF
        self.backoff = min(2 * self.backoff, longest) if self.backoff else FIRST_BACKOFF
        self.next_probe = now + self.backoff

    def late(self, key: Hashable, now: float) -> None:
        """Learn from a reply that came after its request was given up."""
        asked_at = self.outstanding.get(key)
        if asked_at is not None:
            self.learn(now - asked_at)
            if self.health is OFFLINE:
                self.next_probe = now

    def fenced(self) -> None:
        """Believe the node again: it answered a fence, so no older reply is still under way."""
        self.outstanding.clear()
        self.health = ONLINE
        self.misses = 0
        self.backoff = 0.0

    def owe_stop(self, now: float, *, owed: bool) -> None:
        """Note whether the node owes a stop; the probe of one that does is due soon."""
        self.owes_stop = owed
        if owed and self.health is OFFLINE:
            self.next_probe = min(self.next_probe, now + MAX_OWED_BACKOFF)

    @property
    def shown_health(self) -> Health:
        """Its health as people see it: a node that refuses is not well, though it answers."""
        return FAILING if self.failing and self.health is ONLINE else self.health

    def refused(self, reason: str) -> None:
        """Note that it refused a poll."""
        self.refusals += 1
        if self.refusals >= FAILING_AFTER:
            self.failing = reason

    def accepted(self) -> None:
        """Note that it answered a poll with values."""
        self.refusals = 0
        self.failing = ""

    def suspect(self) -> None:
        """Doubt the node because the line was lost."""
        if self.health is ONLINE:
            self.health = DOUBTFUL
        self.next_probe = 0.0
        self.backoff = 0.0


class NodeTable:
    """The nodes of one bus. `changed(node, before)` is called after every change of a node's health."""

    def __init__(
        self, nodes: Collection[int], *, timeout_s: float | None = None, changed: Callable[[Node, Health], None]
    ) -> None:
        """`timeout_s`: the longest wait for a reply beyond its wire time, from the first request on; None: it is learned, and no
        longer than `MAX_ALLOWANCE`."""
        self._max_allowance_s = MAX_ALLOWANCE if timeout_s is None else timeout_s
        self._first_allowance_s = FIRST_ALLOWANCE if timeout_s is None else timeout_s
        self._changed = changed
        self.by_id: dict[int, Node] = {}
        self.troubled: dict[int, Node] = {}
        """Configured nodes that are not online."""
        for node_id in nodes:
            self._add(node_id, configured=True)

    def node(self, node_id: int) -> Node:
        """Return the node of that id. One that is not configured is kept too, but never probed."""
        return self.by_id.get(node_id) or self._add(node_id, configured=False)

    def missed(self, node: Node, key: Hashable, asked_at: float, now: float) -> None:
        before = node.health
        node.missed(key, asked_at, now)
        self._report(node, before)

    def doubt(self, node: Node, key: Hashable, now: float) -> None:
        before = node.health
        node.doubt(key, now)
        self._report(node, before)

    def fenced(self, node: Node) -> None:
        before = node.health
        node.fenced()
        self._report(node, before)

    def refused(self, node: Node, reason: str) -> None:
        """Note that a node refused a poll."""
        before = node.shown_health
        node.refused(reason)
        self._report_failing(node, before)

    def accepted(self, node: Node) -> None:
        """Note that a node answered a poll with values."""
        if node.refusals:
            before = node.shown_health
            node.accepted()
            self._report_failing(node, before)

    def _report_failing(self, node: Node, before: Health) -> None:
        if node.shown_health is not before:
            self._changed(node, before)

    def suspect_all(self) -> None:
        """Doubt every node because the line was lost."""
        for node in self.by_id.values():
            before = node.health
            node.suspect()
            self._report(node, before)

    def reachable(self) -> list[int]:
        """Return the ids that may be asked in a group: the other nodes are asked alone, after a fence."""
        return [node.id for node in self.by_id.values() if node.health is ONLINE]

    def due_probe(self, now: float) -> Node | None:
        """Return the configured node whose probe has been due longest."""
        if not self.troubled:
            return None
        due = [node for node in self.troubled.values() if node.next_probe <= now]
        return min(due, key=lambda node: node.next_probe, default=None)

    def next_probe(self) -> float | None:
        """Return when the next probe is due; None: no node needs one."""
        return min((node.next_probe for node in self.troubled.values()), default=None)

    def _add(self, node_id: int, *, configured: bool) -> Node:
        node = Node(
            node_id,
            configured=configured,
            first_allowance_s=self._first_allowance_s,
            max_allowance_s=self._max_allowance_s,
        )
        if configured:
            self.troubled[node_id] = node
        else:
            node.health = ONLINE  # it was asked nothing yet, so no reply of it can be under way
        self.by_id[node_id] = node
        return node

    def _report(self, node: Node, before: Health) -> None:
        if node.health is before:
            return
        if node.health is ONLINE:
            self.troubled.pop(node.id, None)
        elif node.configured:
            self.troubled[node.id] = node
        self._changed(node, before)
