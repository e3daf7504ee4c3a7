"""Buses that go on, and one that stands still."""

from __future__ import annotations

import pytest

from servobus.daemon.watchdog import Pulse, Watchdog

GOING = Pulse(up=True, frames=10, received=100, waiting=3)


def looks(*pulses: Pulse) -> list[str]:
    watchdog = Watchdog()
    stuck_buses: list[str] = []
    for pulse in pulses:
        stuck_buses = watchdog.stuck({"arm": pulse})
    return stuck_buses


def test_something_waits_and_nothing_happens() -> None:
    assert looks(GOING, GOING) == ["arm"]


@pytest.mark.parametrize(
    "pulses",
    [
        (GOING,),
        (GOING, Pulse(up=True, frames=11, received=100, waiting=3)),
        (GOING, Pulse(up=True, frames=10, received=101, waiting=3)),
        (GOING, Pulse(up=True, frames=10, received=100, waiting=0)),
        (Pulse(up=True, frames=10, received=100, waiting=0), GOING),
        (GOING, Pulse(up=False, frames=10, received=100, waiting=3)),
        (Pulse(up=False, frames=10, received=100, waiting=3), GOING),
    ],
    ids=["first look", "said", "received", "idle now", "idle before", "down now", "down before"],
)
def test_it_goes_on(pulses: tuple[Pulse, ...]) -> None:
    assert looks(*pulses) == []


def test_each_bus_for_itself() -> None:
    watchdog = Watchdog()
    watchdog.stuck({"arm": GOING, "leg": GOING})
    assert watchdog.stuck({"leg": GOING, "new": GOING}) == ["leg"]
