"""A rig on witness lines in virtual time, and what a scenario does with it: see `safety.py`."""

from __future__ import annotations

import asyncio
import random
from collections.abc import AsyncIterator, Awaitable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from servobus.config.loader import parse_config
from servobus.errors import ServobusError
from servobus.rig.local import LocalRig, open_rig
from servobus.values import Outcome
from tests.campaigns.witness import WitnessLine, WitnessServo, witnessed
from tests.campaigns.witness_kst import KstLine, KstServo
from tests.campaigns.witness_roh import RohHand, RohLine
from tests.campaigns.witness_sms import FAMILIES, RESPONSE_LEVEL, SmsLine, SmsServo

POLLS = {"polls": "{feedback: 50, health: 2}", "slow polls": "{health: 1}", "no polls": ""}
READ_ONLY = "status_return: read_only"
"""The servos acknowledge no writes."""
HOME, AWAY, SPEED = "home", "away", "speed"
UNITS = {
    "sms": {HOME: 0.0, AWAY: 30.0, SPEED: 60.0},
    "kst": {HOME: 30.0, AWAY: 50.0, SPEED: 40.0},
    "roh": {HOME: 30.52, AWAY: 70.0, SPEED: 30.0},
}
"""Positions and speeds in the unit of each protocol's servos; at HOME they stand in the beginning."""


@dataclass(frozen=True, slots=True)
class Case:
    """What a scenario is tried with."""

    protocol: str
    model: str = ""
    mode: str = "position"
    polls: str = "polls"
    gateway: bool = False
    keys: str = ""
    """More keys of the bus."""

    def __str__(self) -> str:
        parts = (self.protocol, self.model, self.mode, self.polls, "behind an arm" if self.gateway else "", self.keys)
        return " ".join(part for part in parts if part)


@dataclass(slots=True)
class Figures:
    """What the runs of one row brought. All but `runs` has to be 0."""

    runs: int = 0
    travel: float = 0.0
    """Steps under drive that nobody asked for."""
    false_stops: int = 0
    """Stops that were confirmed while the servo moved on."""
    owed: int = 0
    """Stops that were not paid one second after the servo was reachable again."""
    fired: int = 0
    """REG WRITEs of an earlier program, or of a torn plan, that were carried out."""
    energised: int = 0
    """Goals that energised a servo which had lost its torque or had restarted."""
    broken: list[str] = field(default_factory=list)
    """Other promises that were broken."""

    def kept(self) -> bool:
        return self == Figures(runs=self.runs)

    def add(self, other: Figures) -> None:
        self.runs += other.runs
        self.travel += other.travel
        self.false_stops += other.false_stops
        self.owed += other.owed
        self.fired += other.fired
        self.energised += other.energised
        self.broken += other.broken


class Bench:
    """One line with its servos, for rigs that come one after the other."""

    def __init__(self, case: Case, rng: random.Random, count: int = 3) -> None:
        self.case = case
        self.rng = rng
        self.units = UNITS[case.protocol]
        self.servos = [_servo(case, number) for number in range(1, count + 1)]
        self.line = _line(case, self.servos, rng)
        self._marks = {servo.node: 0.0 for servo in self.servos}

    @property
    def now(self) -> float:
        return asyncio.get_running_loop().time()

    @asynccontextmanager
    async def rig(self, *servo_keys: str, bus_keys: str = "") -> AsyncIterator[LocalRig]:
        """A rig of servos `s1`, `s2`, ... on the line; `servo_keys`: more YAML keys of each."""
        with witnessed(line=self.line):
            config = parse_config(self.text(servo_keys, bus_keys), "campaign", Path())
            async with open_rig(config) as rig:
                yield rig

    def text(self, servo_keys: Sequence[str] = (), bus_keys: str = "") -> str:
        case, polls = self.case, POLLS[self.case.polls]
        rate = {"sms": 1_000_000, "kst": 512_000, "roh": 115_200}[case.protocol]
        lines = ["version: 1", "buses:", "  line:", f"    protocol: {case.protocol}", '    port: "witness://line"']
        lines += [
            f"    baudrate: {rate}",
            f"    poll: {polls}" if polls else "",
            f"    {bus_keys}" if bus_keys else "",
            "    servos:",
        ]
        for number, servo in enumerate(self.servos, start=1):
            keys = servo_keys[number - 1] if number <= len(servo_keys) else ""
            model = {"sms": f", model: {case.model}", "kst": "", "roh": ", channel: index"}[case.protocol]
            lines.append(f"      s{number}: {{id: {servo.node}{model}{keys}}}")
        return "\n".join(line for line in lines if line) + "\n"

    # What moves

    def mark(self) -> None:
        """From now on what is driven is counted."""
        self.line.settle()
        self._marks = {servo.node: servo.driven() for servo in self.servos}
        for servo in self.servos:
            servo.energised_at.clear()

    def travel(self, *numbers: int) -> float:
        """Steps driven since the mark, of these servos or of all; less than a step is rounding."""
        self.line.settle()
        chosen = [self.servos[number - 1] for number in numbers] or self.servos
        ways = [servo.driven() - self._marks[servo.node] for servo in chosen]
        return sum(way for way in ways if way >= 1.0)

    async def travels_within(self, seconds: float, *numbers: int) -> float:
        self.mark()
        await asyncio.sleep(seconds)
        return self.travel(*numbers)


def _servo(case: Case, number: int) -> WitnessServo:
    if case.protocol == "sms":
        servo = SmsServo(number, case.model, mode=case.mode)
        servo.memory[RESPONSE_LEVEL] = case.keys != READ_ONLY
        return servo
    if case.protocol == "kst":
        return KstServo(0x20 + number, position=300.0)
    return RohHand(1 + number)


def _line(case: Case, servos: Sequence[WitnessServo], rng: random.Random) -> WitnessLine:
    if case.protocol == "sms":
        return SmsLine([servo for servo in servos if isinstance(servo, SmsServo)], rng=rng)
    if case.protocol == "kst":
        return KstLine([servo for servo in servos if isinstance(servo, KstServo)], rng=rng)
    return RohLine([servo for servo in servos if isinstance(servo, RohHand)], rng=rng, gateway=case.gateway)


async def tried(verb: Awaitable[object]) -> object:
    """Await a verb; return its error instead of raising it."""
    try:
        return await verb
    except ServobusError as error:
        return error


async def moved(rig: LocalRig, name: str, position: float, speed: float) -> ServobusError | Outcome:
    result = await tried(rig[name].move_to(position, speed=speed))
    assert isinstance(result, ServobusError | Outcome)
    return result


MODES = [Case("sms", model, mode) for model, family in FAMILIES.items() for mode in family.modes]
SMS = [*(case for case in MODES if case.mode == "position"), Case("sms", "sts", keys=READ_ONLY)]
KST, ROH, ARM = Case("kst"), Case("roh"), Case("roh", gateway=True)
FULL_DUPLEX = Case("kst", keys="duplex: full")
ALL = [*SMS, KST, FULL_DUPLEX, ROH, ARM]
WITHOUT_POLLS = [replace(case, polls=polls) for case in ALL for polls in POLLS]
