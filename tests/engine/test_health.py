"""Health: how long a reply is waited for, when a node is believed, and how often a silent one is probed."""

from __future__ import annotations

import pytest

from servobus.engine.health import (
    FAILING_AFTER,
    FIRST_ALLOWANCE,
    FIRST_BACKOFF,
    MAX_ALLOWANCE,
    MAX_BACKOFF,
    MAX_OUTSTANDING,
    MAX_OWED_BACKOFF,
    MIN_ALLOWANCE,
    OFFLINE_AFTER,
    Node,
    NodeTable,
)
from servobus.values import Health

ONLINE, DOUBTFUL, OFFLINE = Health.ONLINE, Health.DOUBTFUL, Health.OFFLINE


class Watched:
    """The health of nodes 1 and 2, and all changes that were reported."""

    def __init__(self, *, online: bool = True, timeout_s: float | None = None) -> None:
        self.changes: list[tuple[int, Health, Health]] = []
        self.nodes = NodeTable((1, 2), timeout_s=timeout_s, changed=self._changed)
        if online:
            self.nodes.fenced(self.node)
            self.nodes.fenced(self.nodes.node(2))
            self.changes.clear()

    def _changed(self, node: Node, before: Health) -> None:
        self.changes.append((node.id, before, node.health))

    @property
    def node(self) -> Node:
        return self.nodes.node(1)

    def miss(self, times: int = 1, now: float = 0.0) -> None:
        for _ in range(times):
            self.nodes.missed(self.node, "key", now, now)


# Allowances


def test_the_first_request_waits_as_long_as_the_config_says() -> None:
    assert Watched().node.reply_allowance_s == FIRST_ALLOWANCE
    for timeout_s in (0.01, 1.0):
        watched = Watched(timeout_s=timeout_s)
        assert watched.node.reply_allowance_s == timeout_s
        watched.miss(OFFLINE_AFTER)
        assert watched.node.reply_allowance_s == timeout_s, "and so does the first one after it was offline"


def test_the_allowance_is_learned_and_stays_within_its_bounds() -> None:
    node = Watched().node
    for _ in range(100):
        node.learn(0.0001)
    assert node.reply_allowance_s == MIN_ALLOWANCE
    for _ in range(100):
        node.learn(0.02)
    assert 0.02 <= node.reply_allowance_s < 0.021
    for _ in range(100):
        node.learn(5.0)
    assert node.reply_allowance_s == MAX_ALLOWANCE


def test_the_first_answer_sets_mean_and_spread_and_a_jittery_node_is_given_more() -> None:
    steady, jittery = Watched().node, Watched().node
    steady.learn(0.01)
    assert steady.reply_allowance_s == pytest.approx(0.01 + 4 * 0.005)
    for step in range(200):
        steady.learn(0.01)
        jittery.learn(0.01 + 0.004 * (step % 2))
    assert jittery.reply_allowance_s > steady.reply_allowance_s + 0.004


def test_an_answer_that_came_before_it_could_counts_as_immediate() -> None:
    node = Watched().node
    node.learn(-3.0)
    assert node.reply_allowance_s == MIN_ALLOWANCE


def test_the_maximum_of_a_config_holds_even_below_the_minimum() -> None:
    node = Watched(timeout_s=0.002).node
    node.learn(0.0001)
    assert node.reply_allowance_s == 0.002


def test_a_miss_doubles_the_allowance_up_to_the_maximum() -> None:
    watched = Watched(timeout_s=0.03)
    watched.node.learn(0.01)
    watched.node.learn(0.01)
    watched.miss()
    assert watched.node.reply_allowance_s == 0.03, "twice what was learned is more than is allowed"
    watched = Watched()
    watched.miss()
    assert watched.node.reply_allowance_s == 2 * FIRST_ALLOWANCE


def test_a_late_reply_teaches_how_long_it_took() -> None:
    watched = Watched()
    watched.miss(now=1.0)
    watched.node.late("unknown", 1.01)
    assert watched.node.reply_allowance_s == 2 * FIRST_ALLOWANCE, "of an answer nobody gave up nothing is learned"
    watched.node.late("key", 1.03)
    assert watched.node.reply_allowance_s == pytest.approx(0.03 + 4 * 0.015)


# Healths


def test_a_configured_node_is_doubtful_until_a_fence_was_answered() -> None:
    watched = Watched(online=False)
    assert watched.node.health is DOUBTFUL
    assert watched.nodes.reachable() == []
    watched.nodes.fenced(watched.node)
    assert watched.changes == [(1, DOUBTFUL, ONLINE)]
    assert watched.nodes.reachable() == [1]


def test_it_is_doubtful_after_one_miss_and_offline_after_three() -> None:
    watched = Watched()
    for missed in range(1, OFFLINE_AFTER):
        watched.miss()
        assert (watched.node.health, watched.node.misses) == (DOUBTFUL, missed)
    watched.miss()
    assert watched.changes == [(1, ONLINE, DOUBTFUL), (1, DOUBTFUL, OFFLINE)]
    assert watched.node.reply_allowance_s == FIRST_ALLOWANCE
    assert watched.nodes.reachable() == [2]


def test_an_answer_between_two_misses_keeps_it_from_going_offline() -> None:
    watched = Watched()
    for _ in range(10):
        watched.miss(OFFLINE_AFTER - 1)
        watched.node.answered(0x20)
    assert watched.node.health is DOUBTFUL
    assert watched.node.status == 0x20


def test_only_changes_are_reported() -> None:
    watched = Watched()
    watched.miss(OFFLINE_AFTER + 2)
    watched.nodes.fenced(watched.node)
    watched.nodes.fenced(watched.node)
    assert watched.changes == [(1, ONLINE, DOUBTFUL), (1, DOUBTFUL, OFFLINE), (1, OFFLINE, ONLINE)]


def test_a_reply_too_many_makes_an_online_node_doubtful_and_due_for_a_probe() -> None:
    watched = Watched()
    watched.nodes.doubt(watched.node, "key", 3.0)
    assert watched.changes == [(1, ONLINE, DOUBTFUL)]
    assert watched.nodes.due_probe(2.999) is None
    assert watched.nodes.due_probe(3.0) is watched.node
    assert watched.node.misses == 0


def test_a_reply_too_many_does_not_bring_an_offline_node_nearer() -> None:
    watched = Watched()
    watched.miss(OFFLINE_AFTER)
    due = watched.node.next_probe
    watched.nodes.doubt(watched.node, "key", 0.001)
    assert (watched.node.health, watched.node.next_probe) == (OFFLINE, due)


# What may still come


def test_replies_that_may_still_come_are_kept_oldest_first_and_forgotten_by_a_fence() -> None:
    watched = Watched()
    for key, asked_at in (("a", 1.0), ("b", 2.0), ("a", 3.0)):
        watched.nodes.doubt(watched.node, key, asked_at)
    assert list(watched.node.outstanding.items()) == [("b", 2.0), ("a", 3.0)]
    watched.nodes.fenced(watched.node)
    assert watched.node.outstanding == {}


def test_no_more_than_so_many_are_kept() -> None:
    node = Watched().node
    for key in range(MAX_OUTSTANDING):
        node.doubt(key, 0.0)
    assert list(node.outstanding) == list(range(MAX_OUTSTANDING))
    node.doubt("one more", 0.0)
    assert list(node.outstanding) == [*range(1, MAX_OUTSTANDING), "one more"]


# Probes


def test_a_doubtful_node_is_probed_at_once_and_an_offline_one_ever_more_seldom() -> None:
    watched, now, pauses = Watched(), 0.0, []
    watched.miss(OFFLINE_AFTER - 1, now=5.0)
    assert watched.nodes.due_probe(5.0) is watched.node
    for _ in range(9):
        watched.miss(now=now)
        pauses.append(watched.node.next_probe - now)
        now = watched.node.next_probe
    expected = [min(FIRST_BACKOFF * 2**step, MAX_BACKOFF) for step in range(9)]
    assert pauses == pytest.approx(expected)
    assert pauses[-2:] == pytest.approx([MAX_BACKOFF, MAX_BACKOFF])


def test_a_node_that_owes_a_stop_is_probed_twice_in_the_time_that_an_exit_leaves_to_one_that_is_deaf_for_0_6_s() -> None:
    """An exit waits 1 s for the stops that are owed."""
    watched = Watched()
    watched.miss(OFFLINE_AFTER + 9, now=5.0)
    watched.node.owe_stop(5.0, owed=True)
    assert watched.node.next_probe == 5.0 + MAX_OWED_BACKOFF
    watched.miss(now=5.2)
    assert watched.node.next_probe == 5.2 + MAX_OWED_BACKOFF
    assert 2 * MAX_OWED_BACKOFF <= 1.0 - 0.6


def test_after_it_came_back_the_backoff_starts_anew() -> None:
    watched = Watched()
    watched.miss(OFFLINE_AFTER + 4)
    watched.nodes.fenced(watched.node)
    assert watched.nodes.next_probe() is None
    watched.miss(OFFLINE_AFTER, now=7.0)
    assert watched.node.next_probe == 7.0 + FIRST_BACKOFF


def test_the_one_that_has_waited_longest_is_probed_first() -> None:
    watched = Watched()
    second = watched.nodes.node(2)
    watched.nodes.missed(second, "key", 1.0, 1.0)
    watched.miss(now=2.0)
    assert watched.nodes.next_probe() == 1.0
    assert watched.nodes.due_probe(0.5) is None
    assert watched.nodes.due_probe(2.0) is second


def test_a_late_reply_of_an_offline_node_brings_its_probe_forward() -> None:
    watched = Watched()
    watched.miss(OFFLINE_AFTER)
    watched.node.late("key", 0.01)
    assert watched.nodes.due_probe(0.01) is watched.node


def test_a_node_that_is_not_configured_is_never_probed() -> None:
    watched = Watched()
    stranger = watched.nodes.node(9)
    assert stranger is watched.nodes.node(9)
    assert stranger.health is ONLINE, "nothing was asked of it, so nothing can be under way"
    for _ in range(OFFLINE_AFTER):
        watched.nodes.missed(stranger, "key", 0.0, 0.0)
    assert (stranger.health, watched.changes[-1]) == (OFFLINE, (9, DOUBTFUL, OFFLINE))
    assert watched.nodes.next_probe() is None
    assert watched.nodes.due_probe(100.0) is None


def test_after_the_line_was_gone_everybody_is_asked_before_being_believed() -> None:
    watched = Watched()
    second = watched.nodes.node(2)
    for _ in range(OFFLINE_AFTER + 3):
        watched.nodes.missed(second, "key", 50.0, 50.0)
    watched.changes.clear()
    watched.nodes.suspect_all()
    assert watched.changes == [(1, ONLINE, DOUBTFUL)]
    assert (second.health, second.backoff) == (OFFLINE, 0.0)
    assert watched.nodes.next_probe() == 0.0
    assert watched.node.next_probe == second.next_probe == 0.0
    assert second.outstanding, "what was under way may come yet"


# Refusals


def test_a_node_that_refuses_its_polls_is_failing_with_the_reason() -> None:
    watched = Watched()
    for _ in range(FAILING_AFTER):
        assert watched.node.shown_health is ONLINE
        watched.nodes.refused(watched.node, "busy")
    assert (watched.node.shown_health, watched.node.failing) == (Health.FAILING, "busy")
    assert watched.node.health is ONLINE, "it answers: it needs no fence"
    watched.nodes.accepted(watched.node)
    assert watched.node.shown_health is ONLINE
    assert [change[1] for change in watched.changes] == [ONLINE, Health.FAILING]


def test_a_failing_node_that_falls_silent_is_doubtful() -> None:
    watched = Watched()
    for _ in range(FAILING_AFTER):
        watched.nodes.refused(watched.node, "busy")
    watched.miss()
    assert watched.node.shown_health is DOUBTFUL
