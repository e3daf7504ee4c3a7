"""Verbs and troubles in any order: what somebody asked for is kept in a small model, and everything else must not travel.

The model knows of each servo when `enable` was under way and whether a motion was asked for since. So a torque that goes on
outside of `enable`, and a joint that is driven while nobody asked, are found whatever the order of events was.
"""

from __future__ import annotations

import asyncio
import random
from collections.abc import Awaitable, Callable, Coroutine
from dataclasses import dataclass, field, replace
from typing import Any

from servobus.errors import ServobusError
from servobus.rig.local import LocalRig
from servobus.values import StopReport
from tests.campaigns.bench import ALL, AWAY, HOME, MODES, SMS, SPEED, Bench, Case, Figures, moved, tried
from tests.campaigns.scenarios_stops import EFFECT
from tests.campaigns.witness import NEVER, WitnessServo
from tests.campaigns.witness_sms import SmsServo, status

STEPS = 60
ALTERED = 0.01
"""Share of replies whose data is altered in a way that the sum does not show."""
NAMES = ("s1", "s2", "s3")


@dataclass(slots=True)
class Asked:
    """What was asked of one servo."""

    moves: bool = False
    """A motion was asked for, and has not been ended since."""
    rests_from: float = 0.0
    """From then on it may not be driven, where no motion is asked for."""
    enables: list[tuple[float, float]] = field(default_factory=list)
    driven: float = 0.0


class Mixed:
    """One run."""

    def __init__(self, bench: Bench, rig: LocalRig, figures: Figures) -> None:
        self.bench, self.rig, self.figures = bench, rig, figures
        self.rng = bench.rng
        self.asked = {name: Asked() for name in NAMES}

    def servo(self, name: str) -> WitnessServo:
        return self.bench.servos[NAMES.index(name)]

    async def run(self) -> None:
        for _ in range(STEPS):
            step = self.rng.choice(STEPS_OF[self.bench.case.protocol])
            await step(self)
            self.check(step.__name__)
            await asyncio.sleep(self.rng.choice([0.0, self.rng.uniform(0, 0.3)]))
            self.check(f"{step.__name__}, later")

    def check(self, after: str) -> None:
        """Nobody was driven who was not asked to move."""
        now = self.bench.now
        self.bench.line.settle()
        for name, asked in self.asked.items():
            way, asked.driven = self.servo(name).driven() - asked.driven, self.servo(name).driven()
            if not asked.moves and asked.rests_from <= now and way >= 1.0:
                self.figures.travel += way
                self.figures.broken.append(f"{name} was driven after {after}")

    def rests(self, name: str) -> None:
        """Its motion has been ended; it may come back to where it is held."""
        self.asked[name].moves = False
        self.asked[name].rests_from = self.bench.now + EFFECT
        asyncio.get_running_loop().call_later(EFFECT, self._count_anew, name)

    def _count_anew(self, name: str) -> None:
        """What it was driven until now is its way to where it is held."""
        self.bench.line.settle()
        self.asked[name].driven = self.servo(name).driven()

    # Verbs

    async def enable(self) -> None:
        name = self.rng.choice(NAMES)
        began = self.bench.now
        error = await tried(self.rig.enable(name))
        self.asked[name].enables.append((began, self.bench.now))
        if not isinstance(error, ServobusError):
            self.rests(name)

    async def disable(self) -> None:
        name = self.rng.choice(NAMES)
        if not isinstance(await tried(self.rig.disable(name)), ServobusError):
            self.rests(name)

    async def move(self) -> None:
        name = self.rng.choice(NAMES)
        self.asked[name].moves |= self.rig.state(name).enabled
        if self.bench.case.mode == "velocity":
            await tried(self.rig[name].spin(self.rng.uniform(-1, 1) * self.bench.units[SPEED]))
        else:
            await moved(self.rig, name, self._position(), self.bench.units[SPEED])

    def _position(self) -> float:
        units = self.bench.units
        return self.rng.uniform(units[HOME], units[AWAY])

    async def move_together(self) -> None:
        names = self.rng.sample(NAMES, 2)
        if self.bench.case.mode == "velocity" or not all(self.rig.state(name).enabled for name in names):
            return
        for name in names:
            self.asked[name].moves = True
        goals = {name: self._position() for name in names}
        await tried(self.rig.move(goals, together=True, confirm=self.rng.random() < 0.7, speed=self.bench.units[SPEED]))

    async def stop(self) -> None:
        await self._stop(self.rig.stop())

    async def abandon(self) -> None:
        await self._stop(self.rig.abandon([f"line/{name}" for name in NAMES]))

    async def _stop(self, verb: Awaitable[dict[str, StopReport]]) -> None:
        reports = await verb
        for name in NAMES:
            report = reports.get(f"line/{name}")
            if report is not None and report.confirmed:
                self.rests(name)

    async def clear(self) -> None:
        await tried(self.rig.clear())

    async def read(self) -> None:
        await tried(self.rig.read(self.rng.choice(NAMES)))

    # Troubles

    async def power_off(self) -> None:
        name = self.rng.choice(NAMES)
        servo = self.servo(name)
        servo.cut_power(self.bench.now, self.rng.choice([0.0, 0.2, 1.0]))
        if isinstance(servo, SmsServo):
            self.asked[name].moves = False
            self.asked[name].rests_from = self.bench.now

    async def protection(self) -> None:
        name = self.rng.choice(NAMES)
        servo = self.servo(name)
        assert isinstance(servo, SmsServo)
        servo.deaf_until = servo.mute_until = NEVER  # nothing can tell that the torque of a silent servo is gone
        servo.loss = 0.0
        await asyncio.sleep(0.002)  # what has left arrives
        servo.advance(self.bench.now)
        servo.trip()
        await asyncio.sleep(0.01)  # a goal may leave on what was read a few ms before

    async def deaf(self) -> None:
        self.servo(self.rng.choice(NAMES)).deaf_until = self.bench.now + self.rng.choice([0.05, 0.5, 1.0])

    async def mute(self) -> None:
        self.servo(self.rng.choice(NAMES)).mute_until = self.bench.now + self.rng.choice([0.05, 0.5, 1.0])

    async def lossy(self) -> None:
        self.servo(self.rng.choice(NAMES)).loss = self.rng.choice([0.0, 0.0, 0.2])


Step = Callable[[Mixed], Coroutine[Any, Any, None]]
VERBS: list[Step] = [*[Mixed.enable] * 4, *[Mixed.move] * 6, *[Mixed.clear] * 3, Mixed.disable, Mixed.read]
TROUBLES: list[Step] = [Mixed.stop, Mixed.abandon, Mixed.deaf, Mixed.mute, Mixed.lossy]
STEPS_OF: dict[str, list[Step]] = {
    "sms": [*VERBS, *TROUBLES, *[Mixed.move_together] * 3, Mixed.power_off, Mixed.protection],
    "kst": VERBS + TROUBLES,  # what it does after a restart is its own
    "roh": VERBS + TROUBLES,
}


async def mixed(case: Case, rng: random.Random, figures: Figures) -> None:
    """Verbs and troubles in any order."""
    await _run(Bench(case, rng, 3), figures)


async def altered(case: Case, rng: random.Random, figures: Figures) -> None:
    """The same, and one reply in a hundred has another bit somewhere in its data, with the right sum."""
    bench = Bench(case, rng, 3)
    bench.line.alter = lambda node, reply: _altered(reply, rng)
    await _run(bench, figures)


def _altered(reply: bytes, rng: random.Random) -> bytes:
    data = bytearray(reply[5:-1])
    if not data or rng.random() > ALTERED:
        return reply
    data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return status(reply[2], reply[4], bytes(data))


async def _run(bench: Bench, figures: Figures) -> None:
    policies = [("",), ("", ", on_estop: limp"), (", on_lost_client: limp",)] if bench.case.protocol == "sms" else [("",)]
    async with bench.rig(*bench.rng.choice(policies)) as rig:
        run = Mixed(bench, rig, figures)
        await run.run()
    if bench.case.protocol == "sms":
        for name, asked in run.asked.items():
            outside = [at for at in run.servo(name).energised_at if not any(begin <= at <= end for begin, end in asked.enables)]
            figures.energised += len(outside)


VELOCITY = [case for case in MODES if case.mode == "velocity"]
CASES = [replace(case, polls=polls) for case in (*ALL, *VELOCITY) for polls in ("polls", "no polls")]
RULES = [
    ("all: verbs and troubles in any order", mixed, CASES, 1000),
    ("e any reply altered, in any order", altered, [*SMS, *VELOCITY], 280),
]
