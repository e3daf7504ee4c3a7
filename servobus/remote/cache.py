"""What a client keeps of the rig it is connected to: names, states, the e-stop, statistics. Pure: the time is given."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from servobus.errors import LinkDown
from servobus.values import Health, Snapshot, State


def received(state: State, now: float) -> State:
    """The state with its time on this machine, whose clock may differ from the daemon's."""
    return replace(state, time=None if state.age is None else now - state.age)


class StateCache:
    """Filled again by each connection. `down` is set while there is none."""

    def __init__(self) -> None:
        self.names: dict[str, tuple[str, str]] = {}
        self.stopped = False
        self.down: LinkDown | None = None
        self._states: Snapshot = {}
        self._stats: dict[str, Any] = {}

    def put(self, states: Mapping[str, State]) -> None:
        """What comes last is the newest: a connection keeps the order."""
        self._states = {**self._states, **states}

    def aged(self, states: Mapping[str, State], now: float) -> Snapshot:
        """The states with their present age, and offline while there is no connection."""
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

    def put_stats(self, stats: dict[str, Any]) -> None:
        self._stats = stats

    def stats(self) -> dict[str, Any]:
        """The last statistics. Raises LinkDown while there is no connection, because they have no age."""
        if self.down is not None:
            raise LinkDown(self.down.message)
        return self._stats


class LatestSnapshot:
    """Holds one snapshot: a newer one replaces it."""

    def __init__(self) -> None:
        self._states: Snapshot | None = None
        self._changed = asyncio.Event()

    def put(self, states: Snapshot) -> None:
        self._states = states
        self._changed.set()

    async def get(self) -> Snapshot:
        while self._states is None:
            self._changed.clear()
            await self._changed.wait()
        states, self._states = self._states, None
        return states
