"""Which leases a client holds as far as it knows: the time is given."""

from __future__ import annotations

from servobus.remote.held_leases import HeldLeases

A, B = "arm/a", "arm/b"


def leases() -> HeldLeases:
    made = HeldLeases()
    made.ttl = 0.5
    return made


def test_nothing_was_lost_by_who_held_nothing() -> None:
    assert leases().to_acquire([A, B], 1000.0) == set()


def test_what_is_renewed_in_time_is_held() -> None:
    mine = leases()
    mine.taken([A], 10.0)
    assert mine.to_acquire([A], 10.49) == set()
    mine.renewed([A], 10.3)
    assert mine.to_acquire([A], 10.79) == set()


def test_what_was_not_renewed_is_to_be_acquired_until_it_is() -> None:
    mine = leases()
    mine.taken([A], 10.0)
    assert mine.to_acquire([A, B], 10.5) == {A}
    assert mine.to_acquire([A], 11.0) == {A}
    assert mine.to_acquire([B], 11.0) == set()
    mine.taken([A], 11.0)
    assert mine.to_acquire([A], 11.1) == set()


def test_what_the_daemon_does_not_confirm_is_lost() -> None:
    mine = leases()
    mine.taken([A, B], 10.0)
    mine.renewed([B], 10.2)
    assert mine.to_acquire([A, B], 10.3) == {A}


def test_an_older_wish_does_not_shorten_a_lease() -> None:
    mine = leases()
    mine.taken([A], 10.0)
    mine.taken([B], 9.0)
    assert mine.to_acquire([A, B], 10.4) == set()


def test_what_was_refused_needs_a_new_wish() -> None:
    mine = leases()
    mine.taken([A, B], 10.0)
    mine.refused([A])
    assert mine.to_acquire([A, B], 10.1) == {A}


def test_neither_a_release_nor_a_new_connection_is_a_loss() -> None:
    mine = leases()
    mine.taken([A, B], 10.0)
    mine.released([A])
    assert mine.held == {B}
    assert mine.to_acquire([A], 99.0) == set()
    mine.clear()
    assert mine.to_acquire([A, B], 99.0) == set()
    assert mine.held == set()
