"""What a client keeps of a rig it is connected to: names, states, the e-stop, statistics. The time is given."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from servobus.errors import LinkDown
from servobus.values import Health, Snapshot, State


def received(state: State, now: float) -> State:
    """Its time on this machine, which may have another clock than the daemon's."""
    return replace(state, time=None if state.age is None else now - state.age)


class StateCache:
    """Filled by every connection anew; `down` while there is none."""

    def __init__(self) -> None:
        self.names: dict[str, tuple[str, str]] = {}
        self.stopped = False
        self.down: LinkDown | None = None
        self._states: Snapshot = {}
        self._stats: dict[str, Any] = {}

    def know(self, states: Mapping[str, State]) -> None:
        """What came last is the newest: a connection keeps the order."""
        self._states = {**self._states, **states}

    def aged(self, states: Mapping[str, State], now: float) -> Snapshot:
        """As they are now: older than when they came, and offline while there is no daemon to tell."""
        return {
            name: replace(
                state,
                age=None if state.time is None else max(0.0, now - state.time),
                health=state.health if self.down is None else Health.OFFLINE,
            )
            for name, state in states.items()
        }

    def snapshot(self, now: float) -> Snapshot:
        nothing = State()
        return self.aged({name: self._states.get(name, nothing) for name in self.names}, now)

    def counted(self, stats: dict[str, Any]) -> None:
        self._stats = stats

    def stats(self) -> dict[str, Any]:
        """Raises LinkDown: figures do not tell their age."""
        if self.down is not None:
            raise LinkDown(self.down.message)
        return self._stats


class LatestSnapshot:
    """A place for one snapshot: what was not fetched is replaced."""

    def __init__(self) -> None:
        self._states: Snapshot | None = None
        self._some = asyncio.Event()

    def put(self, states: Snapshot) -> None:
        self._states = states
        self._some.set()

    async def get(self) -> Snapshot:
        while self._states is None:
            self._some.clear()
            await self._some.wait()
        states, self._states = self._states, None
        return states
