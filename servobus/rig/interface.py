"""Rig and Servo: the interface of every door and every app, the same in this process and through a daemon.

A servo is named "arm/elbow", or "elbow" where that is unique. Positions are in the servo's unit (degrees unless its model or its
config says otherwise), speeds in unit/s, times in seconds. Every verb may raise LinkDown, ReplyTimeout, UnknownName and
Overloaded besides what its own text says. `rig/verbs.py` derives every other form of these verbs from the signatures here.
"""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping
from typing import Any

from servobus.errors import UnknownName
from servobus.rig.events import EventStream
from servobus.values import Change, Goal, Identity, Outcome, Reload, ScanHit, Snapshot, State, StopReport


def full_name(names: Mapping[str, tuple[str, str]], name: str) -> str:
    """Return "bus/servo" for a full or a unique bare name; `names` as in `Rig.names`. Raises UnknownName, TypeError."""
    if not isinstance(name, str):
        raise TypeError(f"the name of a servo is a string, not {name!r}: write enable('a', 'b') or enable(*names) for several")
    if name in names:
        return name
    matches = [full for full, (_, servo) in names.items() if servo == name]
    if len(matches) == 1:
        return matches[0]
    if matches:
        raise UnknownName(f"{name!r} is on several buses: say one of {', '.join(matches)}")
    raise UnknownName(f"no servo {name!r}: there are {', '.join(names) or 'none'}")


class Servo:
    """One servo of a rig: the verbs of `Rig` with the name filled in.

    Attributes:
        rig: The rig it belongs to.
        name: Its full name, "bus/servo".
    """

    def __init__(self, rig: Rig, name: str) -> None:
        self.rig = rig
        self.name = name

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
        """Send the servo to a position. Returns when the goal is delivered, not when it is reached (see `settle`).

        Args:
            position: In the servo's unit.
            speed: In unit/s; None: the servo's `speed`, else its `max_speed`, else the model's.
            duration: Seconds the motion is to take; not together with `speed`.
            acceleration: In unit/s^2; None: the servo's own setting.
            effort: In percent of the greatest torque; None: the servo's own setting.
            start_within: Seconds within which the first byte must leave; None: the servo's `ttl`.
            confirm: True: the servo acknowledges the goal before it starts.

        Returns: ACKED (the servo confirmed it), SENT (the protocol has no reply) or SUPERSEDED (a newer goal replaced it).
        Raises: LimitError, NotEnabled, EStopped, LeaseHeld, Busy, GoalExpired; ReplyTimeout (it may have been applied).
        Documents: SMS 1.0, 1.3.3 to 1.4.5; KST RS422, 3.5; ROH Modbus, 3.3.
        """
        goal = Goal("position", position, speed, duration, acceleration, effort, start_within)
        return await self.rig.send(self.name, goal, confirm=confirm)

    async def spin(self, velocity: float, *, acceleration: float | None = None, effort: float | None = None) -> Outcome:
        """Turn a servo in wheel mode at a velocity, until it gets another goal.

        Args:
            velocity: In unit/s; the sign is the direction, 0 stops.
            acceleration: In unit/s^2; None: the servo's own setting.
            effort: In percent of the greatest torque; None: the servo's own setting.

        Returns and raises: as `move_to`.
        """
        return await self.rig.send(self.name, Goal("velocity", velocity, acceleration=acceleration, effort=effort))

    async def settle(self, *, tolerance: float | None = None, timeout: float = 10.0) -> State:
        """Wait until the servo is at its goal and at rest.

        Args:
            tolerance: Distance from the goal that is near enough, in its unit; None: that of its model.
            timeout: Seconds after which it gives up.

        Returns: The state in which it came to rest.
        Raises: SettleTimeout (with where it is), EStopped, NotEnabled.
        """
        return (await self.rig.settle(self.name, tolerance=tolerance, timeout=timeout))[self.name]

    async def enable(self) -> None:
        """Switch the torque on where the servo is. Raises and refuses as `Rig.enable`."""
        await self.rig.enable(self.name)

    async def disable(self) -> None:
        """Switch the torque off. Raises as `Rig.disable`."""
        await self.rig.disable(self.name)

    async def read(self, *, max_age: float | None = None) -> State:
        """Read the servo's state; see `Rig.read` for `max_age` (seconds)."""
        return await self.rig.read(self.name, max_age=max_age)

    async def read_register(self, register: str, *, raw: bool = False) -> Any:
        """Read one register; see `Rig.read_register` for `register` and `raw`."""
        return await self.rig.read_register(self.name, register, raw=raw)

    async def write_register(self, register: str, value: Any, *, raw: bool = False, persist: bool = False) -> Any:
        """Write one register; see `Rig.write_register` for `register`, `value`, `raw` and `persist`."""
        return await self.rig.write_register(self.name, register, value, raw=raw, persist=persist)

    async def ping(self) -> int | None:
        """Ask the servo for a sign of life; see `Rig.ping`."""
        return await self.rig.ping(self.name)

    async def identify(self) -> Identity:
        """Ask the servo what it is; see `Rig.identify`."""
        return await self.rig.identify(self.name)


class Rig(ABC):
    """All buses of one config. `rig["elbow"]` is a servo, `for servo in rig` goes through all of them.

    `servobus.open` makes one whose ports this process owns, `servobus.connect` one of a running daemon.
    """

    @property
    @abstractmethod
    def names(self) -> Mapping[str, tuple[str, str]]:
        """Full name -> (bus, servo), in the order of the config."""

    @property
    @abstractmethod
    def stopped(self) -> bool:
        """Whether the e-stop is latched."""

    def __getitem__(self, name: str) -> Servo:
        return Servo(self, self.full_name(name))

    def __iter__(self) -> Iterator[Servo]:
        return iter([Servo(self, name) for name in self.names])

    def full_name(self, name: str) -> str:
        """Return "bus/servo" for the `name` of a servo, full or bare. Raises UnknownName, which lists what there is."""
        return full_name(self.names, name)

    def full_names(self, names: Iterable[str]) -> list[str]:
        """Return the full names of several; without `names`: of all servos. Raises UnknownName."""
        return [self.full_name(name) for name in names] or list(self.names)

    # Motion

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
        """Send several servos to positions. All goals are checked before a byte is sent.

        Args:
            positions: Name -> position in the servo's unit.
            together: True: the servos of one bus start at the same moment.
            confirm: True: every servo acknowledges its goal before any of them starts.
            speed: In unit/s, for each; None: each servo's own.
            duration: Seconds the motion is to take; not together with `speed`.
            start_within: Seconds within which the first byte must leave; None: each servo's `ttl`.

        Returns: The outcome of each, by full name, as in `Servo.move_to`.
        Raises: PartialFailure with the outcome or error of each; InvalidRequest (a servo is named twice); as `Servo.move_to`.
        """
        goals = {name: Goal("position", value, speed, duration, start_within=start_within) for name, value in positions.items()}
        return await self.send_all(goals, together=together, confirm=confirm)

    async def send(self, name: str, goal: Goal, *, confirm: bool = False) -> Outcome:
        """Send one goal of any kind to the servo `name`; `confirm`, result and errors as in `Servo.move_to`."""
        full = self.full_name(name)
        return (await self.send_all({full: goal}, confirm=confirm))[full]

    @abstractmethod
    async def send_all(self, goals: Mapping[str, Goal], *, together: bool = False, confirm: bool = False) -> dict[str, Outcome]:
        """Send `goals` of any kind, by name; `together`, `confirm` and all else as in `move`. One goal raises its own error."""

    @abstractmethod
    async def enable(self, *names: str) -> None:
        """Switch torque on: the goal becomes the present position first, so that nothing travels.

        Args:
            names: Servos; none: all.

        Raises: EStopped, Busy, DeviceError, NotSupported (the servo's own settings would make it travel); for several servos
            PartialFailure with the error of each that failed.
        """

    @abstractmethod
    async def disable(self, *names: str) -> None:
        """Switch torque off and read it back. Every servo is tried; it is allowed at any time.

        Args:
            names: Servos; none: all.

        Raises: Busy, DeviceError; for several servos PartialFailure.
        """

    @abstractmethod
    async def stop(self) -> dict[str, StopReport]:
        """Stop everything (e-stop): all buses at once, each servo as its `on_estop` says, latched until `clear`.

        Returns: What was written and what was confirmed, by full name. It never raises for a servo or a bus that failed.
        """

    @abstractmethod
    async def clear(self) -> tuple[str, ...]:
        """Release the e-stop. Nothing moves by it. Raises Busy while servos are still being stopped or parked.

        Returns: Full names of the servos that have not confirmed their stop: they are stopped as soon as they answer."""

    @abstractmethod
    async def settle(self, *names: str, tolerance: float | None = None, timeout: float = 10.0) -> Snapshot:
        """Wait until servos are at their goals and at rest.

        Args:
            names: Servos; none: all.
            tolerance: Distance from the goal that is near enough, in the servo's unit; None: that of its model.
            timeout: Seconds after which it gives up.

        Returns: The state of each, by full name.
        Raises: SettleTimeout (with where the servo is), EStopped, NotEnabled.
        """

    @abstractmethod
    async def acquire(self, *names: str) -> None:
        """Take the motion lease of these servos, or of all without `names`: nobody else moves them until `release`.

        A motion takes it by itself. In a process that owns its ports there is nobody else. Raises LeaseHeld.
        """

    @abstractmethod
    async def release(self, *names: str) -> None:
        """Give the lease of these servos back, or of all without `names`. A motion under way goes on to its goal."""

    # Reading

    @abstractmethod
    async def read(self, name: str, *, max_age: float | None = None) -> State:
        """Read the state of a servo.

        Args:
            name: The servo.
            max_age: Seconds: a state that is no older is returned without a turn; None: a fresh turn.

        Documents: SMS 1.0, 1.3.2; KST RS422, 3.6 to 3.8; ROH Modbus, 3.1.
        """

    @abstractmethod
    def snapshot(self) -> Snapshot:
        """Return the last known state of every servo, without a turn."""

    async def watch(self, hz: float = 10.0) -> AsyncIterator[Snapshot]:
        """Yield snapshots `hz` times a second, above 0 up to 1000. A slow reader gets fewer, never old ones."""
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
    def events(self) -> EventStream:
        """Return a stream of what happens from this call on: servos that come and go, faults, stops (see `EventName`).

        A reader that is 256 events behind loses the oldest; `Event.missed` says how many.
        """

    @abstractmethod
    def stats(self) -> dict[str, Any]:
        """Return counters and latencies, by bus: turns, time-outs, load of the line in percent, times in ms, and its nodes."""

    @abstractmethod
    async def read_register(self, name: str, register: str, *, raw: bool = False) -> Any:
        """Read one register.

        Args:
            name: The servo.
            register: Its name or alias in the model file; ADDR:LEN returns bytes.
            raw: True: the integer of the register instead of the physical value.

        Documents: SMS 1.0, 1.3.2; FEETECH memory table; ROH Modbus, 3.1.
        """

    @abstractmethod
    async def write_register(self, name: str, register: str, value: Any, *, raw: bool = False, persist: bool = False) -> Any:
        """Write one register and return the value that it then holds.

        Args:
            name: The servo.
            register: Its name or alias in the model file.
            value: A physical value in the register's unit.
            raw: True: `value` and the result are the integer of the register.
            persist: True: the value is kept through a restart (EEPROM); only while the servo is disabled.

        Raises: LimitError, NotSupported, DeviceError.
        Documents: SMS 1.0, 1.3.3; FEETECH memory table; ROH Modbus, 3.3.
        """

    @abstractmethod
    async def ping(self, name: str) -> int | None:
        """Ask the servo `name` for a sign of life, even while it counts as offline. Returns its status byte, or None where its
        protocol has none. Documents: SMS 1.0, 1.3.1; KST RS422, 3.4."""

    @abstractmethod
    async def identify(self, name: str) -> Identity:
        """Ask the servo `name` what it is: product, firmware, mode, stored limits, and what does not fit the config."""

    # Commissioning

    @abstractmethod
    async def scan(
        self,
        bus: str,
        *,
        baudrates: Iterable[int] = (),
        ids: Iterable[int] = (),
        progress: Callable[[int, int, ScanHit | None], None] | None = None,
    ) -> list[ScanHit]:
        """Ask ids for a sign of life. Polls pause and motion is refused meanwhile.

        Args:
            bus: The bus.
            baudrates: Rates in bit/s; none: the bus's own.
            ids: Ids to ask; none: every id of the protocol.
            progress: Called after each id with the number asked, the number in all, and what answered.

        Raises: Busy.
        """

    @abstractmethod
    async def set_id(self, bus: str, node: int, new: int, *, save: bool = False) -> Change:
        """Give a servo another id. Exactly one servo must answer there, and nothing on the bus may be enabled.

        Args:
            bus: The bus.
            node: The present id.
            new: The new id.
            save: True: the id is kept through a restart.

        Raises: LimitError, NotSupported, Busy, DeviceError.
        Documents: FEETECH memory table; KST RS422, 3.2 and 3.3; ROH Modbus, 4.1.
        """

    @abstractmethod
    async def set_baudrate(self, bus: str, node: int, baudrate: int, *, save: bool = False) -> Change:
        """Give the servo at id `node` of `bus` another baud rate, `baudrate` in bit/s; `save` and errors as in `set_id`.

        Documents: KST RS422, 3.1 and 3.3.
        """

    @abstractmethod
    async def command(self, bus: str, node: int, name: str, value: int | None = None) -> tuple[str, ...]:
        """Have a servo or hand restart, save, recalibrate ...: what the documents of its protocol offer. It is sent once.

        Args:
            bus: The bus.
            node: The id; nothing on the bus may be enabled.
            name: The command; a wrong one is answered with a list.
            value: The number that some commands take.

        Returns: What a person should know.
        Raises: UnknownName, NotSupported, LimitError, Busy, DeviceError.
        """

    @abstractmethod
    async def reload(self, *, force: bool = False) -> Reload:
        """Read the config file again, all of it or nothing. A bus that is removed, or cannot go on, is left as at exit.

        A bus whose line, servos, ids, models and calibration are the same takes new rates, limits, speeds and policies at once.

        Args:
            force: True: also while a servo of a bus that cannot go on is enabled or owes a stop; False: that is refused.

        Raises: ConfigError, NotSupported (the rig was not opened from a file), Busy (names the servos; nothing has changed).
        """
