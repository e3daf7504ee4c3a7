"""Scenarios of stops, exits and REG WRITEs: what must end, and what must not be left behind."""

from __future__ import annotations

import asyncio
import random

from servobus.errors import ServobusError
from servobus.rig.local import LocalRig
from servobus.values import StopReport
from tests.campaigns.bench import ALL, AWAY, HOME, MODES, SMS, SPEED, Bench, Case, Figures, moved, tried
from tests.campaigns.scenarios_goals import sms
from tests.campaigns.witness import WitnessServo
from tests.campaigns.witness_sms import GOAL, PWM, TORQUE, SmsServo
from tests.campaigns.witness_sms import SPEED as SPEED_WORD

EFFECT = 0.1
"""Seconds in which a joint may come back to where it is held."""


def set_off(servo: SmsServo, now: float) -> None:
    """Another program has left the servo moving, each mode by its own word."""
    servo.advance(now)
    servo.memory[TORQUE] = 1
    if servo.mode == "velocity":
        servo.put(SPEED_WORD, 200, 15)
    elif servo.mode in ("pwm", "motor"):
        servo.put(PWM, 100, 10)
    else:
        servo.put(SPEED_WORD, 100, 15)
        if servo.mode == "step":
            servo.write(GOAL, (30000).to_bytes(2, "little"), now)
        else:
            servo.put(GOAL, servo.family.steps - 1, 15)


async def check_stops(bench: Bench, reports: dict[str, StopReport], figures: Figures) -> None:
    """A stop that was confirmed has an end: the servo rests a moment later."""
    await asyncio.sleep(EFFECT)
    await bench.travels_within(1.0)
    for number in range(1, len(bench.servos) + 1):
        way = bench.travel(number)
        if reports[f"line/s{number}"].confirmed:
            figures.false_stops += way > 0
            figures.travel += way


async def stop_in_mode(case: Case, rng: random.Random, figures: Figures) -> None:
    """A servo that another program has left moving is stopped, whatever its mode, and confirmed by the effect."""
    bench = Bench(case, rng, 2)
    policy = rng.choice(["", ", on_estop: limp"])
    async with bench.rig(policy) as rig:
        await asyncio.sleep(rng.uniform(0, 0.3))
        set_off(sms(bench.servos[0]), bench.now)
        await asyncio.sleep(rng.uniform(0.02, 0.3))
        reports = await rig.stop()
        await check_stops(bench, reports, figures)
        figures.owed += bench.travel(1) > 0
        figures.broken += [f"not confirmed: {reports['line/s1'].detail}"] if not reports["line/s1"].confirmed else []


async def stop_under_way(case: Case, rng: random.Random, figures: Figures) -> None:
    """Servos that we move are stopped where they are."""
    bench = Bench(case, rng, 3)
    async with bench.rig() as rig:
        await rig.enable("s1", "s2", "s3")
        for number in (1, 2):
            await moved(rig, f"s{number}", bench.units[AWAY], bench.units[SPEED])
        await asyncio.sleep(rng.uniform(0.05, 0.5))
        reports = await rig.stop()
        await check_stops(bench, reports, figures)
        figures.broken += [f"not confirmed: {report.detail}" for report in reports.values() if not report.confirmed]


async def owed(case: Case, rng: random.Random, figures: Figures) -> None:
    """A servo that did not hear the stop is stopped within a second of being reachable again."""
    bench = Bench(case, rng, 3)
    async with bench.rig() as rig:
        await _start_moving(bench, rig)
        await asyncio.sleep(rng.uniform(0.05, 0.3))
        back_at = bench.now
        for servo in bench.servos[: rng.choice([1, 2])]:
            back_at = max(back_at, _disturb(bench, servo, rng))
        await asyncio.sleep(rng.choice([0.0, rng.uniform(0, 0.6)]))
        reports = await rig.stop()
        stopped_at = bench.now
        await check_stops(bench, reports, figures)
        for servo in bench.servos:
            servo.loss = 0.0
        await asyncio.sleep(max(back_at + 1.0 - bench.now, 0.0) + (1.0 if back_at <= stopped_at else 0.0))
        figures.owed += await bench.travels_within(1.0) > 0
        if await rig.clear():
            figures.broken.append("clear names a stop that was paid")


async def _start_moving(bench: Bench, rig: LocalRig) -> None:
    await rig.enable("s1", "s2", "s3")
    for servo in ("s1", "s2"):
        if bench.case.mode == "velocity":
            await rig[servo].spin(bench.units[SPEED] / 4)
        else:
            await moved(rig, servo, bench.units[AWAY], bench.units[SPEED] / 8)


def _disturb(bench: Bench, servo: WitnessServo, rng: random.Random) -> float:
    """Return when it is reachable again."""
    until = bench.now + rng.uniform(0.05, 2.0)
    match rng.choice(["deaf", "mute", "lossy"]):
        case "deaf":
            servo.deaf_until = until
        case "mute":
            servo.mute_until = until
        case _:
            servo.loss = 0.2
            return bench.now
    return until


async def armed_before(case: Case, rng: random.Random, figures: Figures) -> None:
    """A REG WRITE that an earlier program left is not carried out by the confirmed move of other servos."""
    bench = Bench(case, rng, 3)
    third = sms(bench.servos[2])
    third.armed = GOAL, bytes(6)
    trouble = rng.choice(["none", "lossy", "deaf", "deaf at first"])
    third.loss = 0.2 if trouble == "lossy" else 0.0
    third.deaf_until = 0.3 if trouble == "deaf at first" else -1.0
    async with bench.rig() as rig:
        if trouble == "deaf":
            third.deaf_until = bench.now + rng.uniform(0.02, 0.3)
        await rig.enable("s1", "s2")
        bench.mark()
        for position in (5.0, 10.0, 5.0):
            await tried(rig.move({"s1": position, "s2": position}, together=True, confirm=True))
            await asyncio.sleep(rng.uniform(0, 0.2))
    await asyncio.sleep(0.3)
    figures.fired += third.fired
    figures.travel += bench.travel(3)


async def killed_between(case: Case, rng: random.Random, figures: Figures) -> None:
    """A program that is killed between REG WRITE and ACTION leaves nothing that the next program fires."""
    bench = Bench(case, rng, 4)
    receive = bench.line.receive
    async with bench.rig() as rig:
        await rig.enable("s1", "s2", "s3", "s4")
        moving = asyncio.create_task(_together(bench, rig))
        await asyncio.sleep(rng.uniform(0, 0.05))
        bench.line.receive = _silent  # type: ignore[method-assign] # killed: nothing of it gets on the line any more
        moving.cancel()
    bench.line.receive = receive  # type: ignore[method-assign]
    await _next_program(bench, figures)


async def stopped_between(case: Case, rng: random.Random, figures: Figures) -> None:
    """An e-stop or an exit between REG WRITE and ACTION leaves nothing armed."""
    bench = Bench(case, rng, 4)
    for servo in bench.servos:
        servo.loss = rng.choice([0.0, 0.0, 0.05])
    async with bench.rig() as rig:
        if isinstance(await tried(rig.enable("s1", "s2", "s3", "s4")), ServobusError):
            return
        moving = asyncio.create_task(_together(bench, rig))
        await asyncio.sleep(rng.uniform(0, 0.05))
        if rng.random() < 0.7:
            await rig.stop()
        moving.cancel()
    for servo in bench.servos:
        servo.loss = 0.0
    await _next_program(bench, figures)


def _silent(data: bytes) -> None:
    """Take what a killed program would have sent."""


async def _together(bench: Bench, rig: LocalRig) -> None:
    for number in range(20):
        position = bench.rng.choice([5.0, 20.0]) + number
        await tried(rig.move({f"s{each}": position for each in range(1, 5)}, together=True, confirm=True))


async def _next_program(bench: Bench, figures: Figures) -> None:
    """Another program moves two of the four, confirmed; the two others were not even enabled."""
    await asyncio.sleep(1.5)
    before = [sms(servo).fired for servo in bench.servos]
    async with bench.rig() as rig:
        await rig.enable("s1", "s2")
        bench.mark()
        await tried(rig.move({"s1": 0.0, "s2": 0.0}, together=True, confirm=True))
        await asyncio.sleep(0.5)
        figures.travel += bench.travel(3, 4)
    others = zip(bench.servos[2:], before[2:], strict=True)
    figures.fired += sum(sms(servo).fired - count for servo, count in others)


async def leave(case: Case, rng: random.Random, figures: Figures) -> None:
    """At the end everything is held first: nobody travels on while another parks."""
    bench = Bench(case, rng, 3)
    pose = bench.units[HOME] + 12
    other = "limp" if case.protocol == "sms" else "hold"  # the others have no torque command
    keys = (f", on_exit: park, park_pose: {pose}, park_timeout: 4", ", on_exit: hold", f", on_exit: {other}")
    async with bench.rig(*keys) as rig:
        await rig.enable("s1", "s2", "s3")
        for number in (1, 2, 3):
            await moved(rig, f"s{number}", bench.units[AWAY], bench.units[SPEED] / 8)
        await asyncio.sleep(rng.uniform(0.1, 0.5))
        bench.mark()
        asyncio.get_running_loop().call_later(EFFECT, bench.mark)
    await asyncio.sleep(0.5)
    figures.travel += bench.travel(2, 3)


OWED = [*ALL, *(case for case in MODES if case.mode == "velocity")]
RULES = [
    ("2 stop by the rule of the mode", stop_in_mode, MODES, 220),
    ("2 stop of what we move", stop_under_way, ALL, 140),
    ("a armed by an earlier program", armed_before, SMS, 200),
    ("a killed between REG WRITE and ACTION", killed_between, SMS, 200),
    ("a stopped between REG WRITE and ACTION", stopped_between, SMS, 200),
    ("b a stop is owed", owed, OWED, 1000),
    ("g order at the end", leave, ALL, 70),
]
