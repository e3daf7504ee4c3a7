"""Rig and Servo: the interface of every door and every app, the same in this process and through a daemon.

Names: `rig["arm/elbow"]` always works, `rig["elbow"]` where it is unique. Positions are in the servo's unit (deg
unless its model or config says otherwise), speeds in unit/s, times in seconds. Every verb may raise LinkDown,
ReplyTimeout, UnknownName and Overloaded.
"""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from servobus.errors import UnknownName
from servobus.rig.events import EventStream
from servobus.values import Change, Goal, Identity, Outcome, State, StopReport

Snapshot = dict[str, State]
"""Every servo's last known state, by full name."""


@dataclass(frozen=True, slots=True)
class Found:
    """What a scan found."""

    bus: str
    id: int
    baudrate: int
    model: str | None
    """Name of the model file that fits."""
    product: str | None
    firmware: str | None
    note: str = ""


@dataclass(frozen=True, slots=True)
class Reload:
    """What reading the config anew has changed, by bus."""

    added: tuple[str, ...] = ()
    changed: tuple[str, ...] = ()
    """Ended as at exit, and begun anew: their servos are not enabled."""
    removed: tuple[str, ...] = ()


def full_name(names: Mapping[str, tuple[str, str]], name: str) -> str:
    """bus/servo for a full or a unique bare name; `names` as in `Rig.names`. Raises UnknownName and lists what there is."""
    if name in names:
        return name
    matches = [full for full, (_, servo) in names.items() if servo == name]
    if len(matches) == 1:
        return matches[0]
    if matches:
        raise UnknownName(f"{name!r} is on several buses: say one of {', '.join(matches)}")
    raise UnknownName(f"no servo {name!r}: there are {', '.join(names) or 'none'}")


class Servo:
    """One servo of a rig: the rig's verbs with the name filled in."""

    def __init__(self, rig: Rig, name: str) -> None:
        self.rig = rig
        self.name = name
        """bus/servo."""

    def __repr__(self) -> str:
        return f"<Servo {self.name}>"

    async def move_to(
        self,
        position: float,
        *,
        speed: float | None = None,
        duration: float | None = None,
        acceleration: float | None = None,
        effort: float | None = None,
        start_within: float | None = None,
        confirm: bool = False,
    ) -> Outcome:
        """Hand a position over; returns when it was delivered, not when it has arrived (see `settle`). Seed 1.3.3, 1.3.4, 1.4.5.

        `speed` in unit/s or `duration` in s; `effort` in % of the greatest torque; `start_within`: seconds until its first
        byte must leave. Raises LimitError, NotEnabled, EStopped, LeaseHeld, GoalExpired, ReplyTimeout (it may have been applied).
        """
        goal = Goal("position", position, speed, duration, acceleration, effort, start_within)
        return await self.rig.send(self.name, goal, confirm=confirm)

    async def spin(self, velocity: float, *, acceleration: float | None = None, effort: float | None = None) -> Outcome:
        """Turn at a velocity (unit/s, the sign is the direction) until told otherwise; a servo in wheel mode. 0 stops."""
        return await self.rig.send(self.name, Goal("velocity", velocity, acceleration=acceleration, effort=effort))

    async def settle(self, *, tolerance: float | None = None, timeout: float = 10.0) -> State:
        """Wait until it stands at its goal; `tolerance` in its unit. Raises DeviceError with its place after `timeout` s."""
        return (await self.rig.settle(self.name, tolerance=tolerance, timeout=timeout))[self.name]

    async def enable(self) -> None:
        """Goal := present, then torque on. Raises EStopped, DeviceError."""
        await self.rig.enable(self.name)

    async def disable(self) -> None:
        """Torque off, confirmed; allowed at any time. Raises DeviceError."""
        await self.rig.disable(self.name)

    async def read(self, *, max_age: float | None = None) -> State:
        """A fresh turn, or with `max_age` (s) what is known if it is no older than that."""
        return await self.rig.read(self.name, max_age=max_age)

    async def read_register(self, register: str, *, raw: bool = False) -> Any:
        """By name or alias, physical value or the `raw` integer; `ADDR:LEN` gives bytes. Seed 1.3.2."""
        return await self.rig.read_register(self.name, register, raw=raw)

    async def write_register(self, register: str, value: Any, *, raw: bool = False, persist: bool = False) -> Any:
        """Returns the value then in the register. EEPROM needs `persist` and a disabled servo. Raises LimitError, NotSupported,
        DeviceError. Seed 1.3.3."""
        return await self.rig.write_register(self.name, register, value, raw=raw, persist=persist)

    async def ping(self) -> int | None:
        """Its health byte, even if it was offline. Seed 1.3.1."""
        return await self.rig.ping(self.name)

    async def identify(self) -> Identity:
        """Product, firmware, mode, stored limits, and what of it does not fit the config."""
        return await self.rig.identify(self.name)


class Rig(ABC):
    """All buses of one config."""

    @property
    @abstractmethod
    def names(self) -> Mapping[str, tuple[str, str]]:
        """Full name -> (bus, servo), in the order of the config."""

    def __getitem__(self, name: str) -> Servo:
        return Servo(self, self.full_name(name))

    def __iter__(self) -> Iterator[Servo]:
        return iter([Servo(self, name) for name in self.names])

    def full_name(self, name: str) -> str:
        """bus/servo for a full or a unique bare name. Raises UnknownName and lists what there is."""
        return full_name(self.names, name)

    def full_names(self, names: Iterable[str]) -> list[str]:
        """The same for several; none given: all."""
        return [self.full_name(name) for name in names] or list(self.names)

    async def move(
        self,
        positions: Mapping[str, float],
        *,
        together: bool = False,
        confirm: bool = False,
        speed: float | None = None,
        duration: float | None = None,
        start_within: float | None = None,
    ) -> dict[str, Outcome]:
        """Positions for several servos. `together`: those of one bus start at the same moment; `confirm`: each acknowledged
        before any moves. All are checked before a byte is sent. Raises PartialFailure with the outcome of each, and what
        `move_to` raises.
        """
        goals = {name: Goal("position", value, speed, duration, start_within=start_within) for name, value in positions.items()}
        return await self.send_all(goals, together=together, confirm=confirm)

    async def send(self, name: str, goal: Goal, *, confirm: bool = False) -> Outcome:
        """One goal of any kind; see `Servo.move_to`."""
        full = self.full_name(name)
        return (await self.send_all({full: goal}, confirm=confirm))[full]

    @abstractmethod
    async def send_all(self, goals: Mapping[str, Goal], *, together: bool = False, confirm: bool = False) -> dict[str, Outcome]:
        """Goals of any kind; see `move`. With one goal its own error is raised, not PartialFailure."""

    @abstractmethod
    async def enable(self, *names: str) -> None:
        """These servos, or all. Raises PartialFailure with the error of each that failed (a single one raises its own)."""

    @abstractmethod
    async def disable(self, *names: str) -> None:
        """Torque off for these, or all; every one is tried. Raises like `enable`."""

    @abstractmethod
    async def stop(self) -> dict[str, StopReport]:
        """E-stop: on all buses at once, each servo as its `on_estop` says, latched until `clear`. What was written and what was
        confirmed, per servo; never raises for a servo or a bus that failed."""

    @abstractmethod
    async def clear(self) -> None:
        """Release the e-stop. Moves nothing."""

    @property
    @abstractmethod
    def stopped(self) -> bool:
        """The e-stop is latched."""

    @abstractmethod
    async def settle(self, *names: str, tolerance: float | None = None, timeout: float = 10.0) -> Snapshot:
        """Until all stand at their goals. Raises DeviceError."""

    @abstractmethod
    async def read(self, name: str, *, max_age: float | None = None) -> State: ...

    @abstractmethod
    def snapshot(self) -> Snapshot:
        """What is known now, without a turn."""

    async def watch(self, hz: float = 10.0) -> AsyncIterator[Snapshot]:
        """Snapshots at a rate; a slow reader gets fewer, never old ones."""
        if not 0 < hz <= 1000:
            raise ValueError(f"watch: {hz} Hz is outside 0 to 1000")
        clock = asyncio.get_running_loop().time
        due = clock()
        while True:
            yield self.snapshot()
            now = clock()
            due += max(1.0, -(-(now - due) * hz // 1)) / hz  # the next point of the grid that has not passed
            await asyncio.sleep(due - now)

    @abstractmethod
    async def read_register(self, name: str, register: str, *, raw: bool = False) -> Any: ...

    @abstractmethod
    async def write_register(self, name: str, register: str, value: Any, *, raw: bool = False, persist: bool = False) -> Any: ...

    @abstractmethod
    async def ping(self, name: str) -> int | None: ...

    @abstractmethod
    async def identify(self, name: str) -> Identity: ...

    @abstractmethod
    async def scan(
        self,
        bus: str,
        *,
        baudrates: Iterable[int] = (),
        ids: Iterable[int] = (),
        progress: Callable[[int, int, Found | None], None] | None = None,
    ) -> list[Found]:
        """Ask every id, at every rate (none given: the bus's own; every id). Polls pause and motion is refused meanwhile.
        `progress(asked, in all, what was found)`."""

    @abstractmethod
    async def set_id(self, bus: str, node: int, new: int, *, save: bool = False) -> Change:
        """Give the servo at this id another one; with `save` for good. Nothing on the bus may be enabled, and exactly one servo
        must answer there. Raises LimitError, NotSupported, LeaseHeld, DeviceError. KST 3.2, 3.3."""

    @abstractmethod
    async def set_baudrate(self, bus: str, node: int, baudrate: int, *, save: bool = False) -> Change:
        """Give the servo at this id another baud rate, likewise. KST 3.1, 3.3."""

    @abstractmethod
    async def command(self, bus: str, node: int, name: str, value: int | None = None) -> tuple[str, ...]:
        """Tell the servo or hand at this id to restart, save, recalibrate ...: what its protocol's documents have, said once.
        Nothing on the bus may be enabled. Returns what a person should know. Raises UnknownName (and lists what there is),
        NotSupported, LimitError, LeaseHeld, DeviceError."""

    @abstractmethod
    def stats(self) -> dict[str, Any]:
        """Counters and latencies of each bus, and the condition of each node."""

    @abstractmethod
    def events(self) -> EventStream:
        """What happens from now on: servos that come and go, faults, stops. A slow reader loses the oldest and is told."""

    @abstractmethod
    async def acquire(self, *names: str) -> None:
        """Take the motion lease of these servos, or of all: nobody else moves them until `release`. A move takes it by itself;
        in a process that owns its ports there is nobody else. Raises LeaseHeld."""

    @abstractmethod
    async def release(self, *names: str) -> None:
        """Give it back: what moves, moves on to its goal."""

    @abstractmethod
    async def reload(self) -> Reload:
        """Read the config file anew: all of it or nothing. Buses that did not change go on; a changed or removed one ends as at
        exit. Raises ConfigError, NotSupported."""
