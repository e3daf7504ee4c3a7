"""Scenarios of enable and goals: what must not energise, and what must not travel."""

from __future__ import annotations

import asyncio
import random

from servobus.errors import NotEnabled, ServobusError
from tests.campaigns.bench import (
    ALL,
    AWAY,
    FULL_DUPLEX,
    HOME,
    KST,
    MODES,
    SMS,
    SPEED,
    WITHOUT_POLLS,
    Bench,
    Case,
    Figures,
    moved,
    tried,
)
from tests.campaigns.witness import WitnessServo
from tests.campaigns.witness_kst import KstServo
from tests.campaigns.witness_sms import END, MAJOR, MAX_LIMIT, MIN_LIMIT, MINOR, PHASE, TORQUE_LIMIT, SmsServo

KST_SAG = 50
"""Steps: 5 degrees."""


def sms(servo: WitnessServo) -> SmsServo:
    assert isinstance(servo, SmsServo)
    return servo


async def start(case: Case, rng: random.Random, figures: Figures) -> None:
    """A start writes nothing, also where servos are energised, armed or moving."""
    bench = Bench(case, rng)
    for servo in bench.servos:
        servo.deaf_until = rng.choice([-1.0, -1.0, rng.uniform(0, 0.3)])
        if isinstance(servo, SmsServo):
            servo.armed = rng.choice([None, (42, bytes(6))])
    async with bench.rig():
        await asyncio.sleep(rng.uniform(0, 1))
    figures.travel += bench.travel()
    figures.energised += sum(len(servo.energised_at) for servo in bench.servos)


async def enable_outside_limits(case: Case, rng: random.Random, figures: Figures) -> None:
    """A joint outside its stored limits is not energised."""
    bench = Bench(case, rng, 1)
    servo = sms(bench.servos[0])
    low = servo.family.steps // 8 * rng.randrange(5, 7)
    servo.put(MIN_LIMIT, low)
    servo.put(MAX_LIMIT, low + servo.family.steps // 8)
    async with bench.rig() as rig:
        error = await tried(rig.enable("s1"))
        if not isinstance(error, ServobusError):
            figures.broken.append("enable was not refused outside the stored limits")
        await asyncio.sleep(0.5)
        figures.travel += bench.travel()
        figures.energised += len(servo.energised_at)


async def enable_in_mode(case: Case, rng: random.Random, figures: Figures) -> None:
    """Enable moves nothing in any mode, and a position goal is refused where it means something else."""
    bench = Bench(case, rng, 1)
    async with bench.rig() as rig:
        await tried(rig.enable("s1"))
        await asyncio.sleep(0.3)
        figures.travel += bench.travel()
        if case.mode != "position":
            bench.mark()
            if not isinstance(await moved(rig, "s1", bench.units[AWAY], bench.units[SPEED]), ServobusError):
                figures.broken.append("a position goal was sent")
            await asyncio.sleep(0.3)
            figures.travel += bench.travel()
        bench.mark()
        await asyncio.sleep(0.1)
    await asyncio.sleep(0.5)
    figures.travel += bench.travel()


STRANGERS = {"HLS": (0, 10, 7), "SCS-2": (1, 9, 35), "SCS": (1, 5, 4), "STS": (0, 9, 3), "nobody's": (0, 77, 1)}
"""END, major and minor byte."""


async def stranger(case: Case, rng: random.Random, figures: Figures) -> None:
    """A servo of another family, or of none that is known, is not energised and gets no goal."""
    bench = Bench(case, rng, 1)
    servo = sms(bench.servos[0])
    own = ("SCS" if servo.family.big else "STS") if case.model in ("scs", "sts") else ""
    name = rng.choice([name for name in STRANGERS if name != own and not (own == "SCS" and name == "SCS-2")])
    servo.memory[END], servo.memory[MAJOR], servo.memory[MINOR] = STRANGERS[name]
    async with bench.rig() as rig:
        if not isinstance(await tried(rig.enable("s1")), ServobusError):
            figures.broken.append(f"a {name} was enabled as {case.model}")
        await moved(rig, "s1", bench.units[AWAY], bench.units[SPEED])
        await asyncio.sleep(0.3)
    figures.travel += bench.travel()
    figures.energised += len(servo.energised_at)


async def speed_unit(case: Case, rng: random.Random, figures: Figures) -> None:
    """A goal moves at the speed that was asked for, in either unit of the servo."""
    bench = Bench(case, rng, 1)
    servo = sms(bench.servos[0])
    if not servo.family.big:
        servo.memory[PHASE] = rng.choice([0, 4])
    async with bench.rig() as rig:
        await rig.enable("s1")
        bench.mark()
        await moved(rig, "s1", bench.units[AWAY], bench.units[SPEED])
        began, first = bench.now, servo.joint.position
        await asyncio.sleep(0.2)
        bench.line.settle()
        turn = 220 if servo.family.big else 360
        rate = abs(servo.joint.position - first) / (bench.now - began) * turn / servo.family.steps
        if not 0.75 * bench.units[SPEED] <= rate <= 1.2 * bench.units[SPEED]:
            figures.broken.append(f"{bench.units[SPEED]:g} deg/s asked for, phase {servo.memory[PHASE]}: {rate:.0f} deg/s")


async def restart(case: Case, rng: random.Random, figures: Figures) -> None:
    """A servo that was without power for 0 to 2 s is not energised by the next goal."""
    bench = Bench(case, rng, 2)
    servo = bench.servos[0]
    async with bench.rig() as rig:
        await rig.enable("s1", "s2")
        await moved(rig, "s1", bench.units[AWAY], bench.units[SPEED])
        await asyncio.sleep(rng.choice([rng.uniform(0, 0.3), 3.0]))
        outage = rng.choice([0.0, rng.uniform(0, 2)])
        servo.cut_power(bench.now, outage)
        left_at = servo.joint.position if isinstance(servo, KstServo) else 0.0
        await asyncio.sleep(rng.uniform(0.2, outage + 1))
        bench.mark()
        # Nothing shows that a KST servo has restarted but the way that it has gone: load alone explains so much of it.
        shows = not isinstance(servo, KstServo) or abs(servo.joint.position - left_at) > KST_SAG
        await moved(rig, "s1", bench.units[HOME], bench.units[SPEED])
        await asyncio.sleep(0.4)
        await moved(rig, "s1", bench.units[HOME] + 5, bench.units[SPEED])
        await asyncio.sleep(0.4)
        figures.energised += bool(servo.energised_at) and shows
        if isinstance(servo, SmsServo):
            figures.travel += bench.travel(1)


async def torque_lost(case: Case, rng: random.Random, figures: Figures) -> None:
    """Torque that a protection switched off stays off: a stream, a hold and the exit leave the joint limp."""
    bench = Bench(case, rng, 2)
    servo = sms(bench.servos[0])
    servo.joint.gravity = 300.0
    end = rng.choice(["stream", "stop", "exit"])
    async with bench.rig(rng.choice(["", ", on_exit: park, park_pose: 0, on_estop: park"])) as rig:
        await rig.enable("s1", "s2")
        await moved(rig, "s1", bench.units[AWAY], bench.units[SPEED])
        await asyncio.sleep(rng.uniform(0, 1))
        bench.line.settle()
        servo.trip()
        await asyncio.sleep(rng.uniform(0.02, 0.3))
        bench.mark()
        for number in range(10 if end == "stream" else 0):
            await moved(rig, "s1", 20.0 + number, bench.units[SPEED])
            await asyncio.sleep(0.05)
        if end == "stop":
            await rig.stop()
            await asyncio.sleep(0.5)
    await asyncio.sleep(0.5)
    figures.energised += len(servo.energised_at)
    figures.travel += bench.travel(1)


async def one_reading(case: Case, rng: random.Random, figures: Figures) -> None:
    """One altered position, with the right sum, moves nothing when the servo is enabled or stopped."""
    bench = Bench(case, rng, 1)
    servo = sms(bench.servos[0])
    async with bench.rig() as rig:
        await asyncio.sleep(rng.uniform(0, 0.1))
        servo.lies = {servo.position_reads + rng.randrange(8): rng.choice([-1, 1]) * servo.family.steps // 3}
        await tried(rig.enable("s1"))
        await asyncio.sleep(0.5)
        figures.travel += bench.travel()


async def effort(case: Case, rng: random.Random, figures: Figures) -> None:
    """The effort of one goal does not outlive it."""
    bench = Bench(case, rng, 1)
    servo = sms(bench.servos[0])
    own = rng.choice([1000, 700])
    servo.put(TORQUE_LIMIT, own)
    async with bench.rig() as rig:
        await rig.enable("s1")
        await rig["s1"].move_to(bench.units[AWAY], speed=bench.units[SPEED], effort=30)
        await asyncio.sleep(0.01)
        if servo.word(TORQUE_LIMIT) != 300:
            figures.broken.append("the effort of the goal was not written")
        await asyncio.sleep(rng.uniform(0, 0.2))
        await moved(rig, "s1", bench.units[HOME], bench.units[SPEED])
        await asyncio.sleep(0.01)
        if servo.word(TORQUE_LIMIT) != own:
            figures.broken.append("the effort of the goal before caps this one")


async def lead_setpoints(case: Case, rng: random.Random, figures: Figures) -> None:
    """A led servo that did not hear is never sent farther than a step from where it is."""
    bench = Bench(case, rng, 2)
    servo = bench.servos[0]
    assert isinstance(servo, KstServo)
    async with bench.rig(bus_keys="goal_rate: 50") as rig:
        await rig.enable("s1", "s2")
        await moved(rig, "s1", -60.0, bench.units[SPEED])
        await asyncio.sleep(rng.uniform(0, 0.5))
        trouble = rng.choice(["deaf", "mute", "blocked", "lossy"])
        until = bench.now + rng.uniform(0.02, 1.5)
        if trouble == "deaf":
            servo.deaf_until = until
        elif trouble == "mute":
            servo.mute_until = until
        servo.blocked = trouble == "blocked"
        servo.loss = 0.2 if trouble == "lossy" else 0.0
        await asyncio.sleep(until - bench.now)
        servo.blocked = False
        await asyncio.sleep(1.0)
        step = 10 * bench.units[SPEED] / 50
        figures.travel += max(0.0, servo.max_gap - step - 2)


async def cut_motion(case: Case, rng: random.Random, figures: Figures) -> None:
    """A motion that was cut short does not settle as arrived."""
    bench = Bench(case, rng, 2)
    async with bench.rig() as rig:
        await rig.enable("s1", "s2")
        await moved(rig, "s1", bench.units[AWAY], bench.units[SPEED] / 4)
        waiting = asyncio.create_task(tried(rig.settle("s1", timeout=3)))
        await asyncio.sleep(rng.uniform(0.05, 0.4))
        match rng.choice(["stop", "disable", "power"]):
            case "stop":
                await rig.stop()
            case "disable":
                await tried(rig.disable("s1"))
            case _:
                bench.servos[0].cut_power(bench.now, 0.3)
        if not isinstance(await waiting, ServobusError):
            figures.broken.append("settle returned as if it had arrived")


async def dead_stream(case: Case, rng: random.Random, figures: Figures) -> None:
    """A stream to a servo that is dead is told so, not only that its goals were superseded."""
    bench = Bench(case, rng, 2)
    async with bench.rig() as rig:
        await rig.enable("s1", "s2")
        bench.servos[0].deaf_until = 1e9
        results: list[object] = []
        tasks = []
        for number in range(100):
            goal = rig["s1"].move_to(bench.units[HOME] + number / 20, speed=bench.units[SPEED])
            tasks.append(asyncio.create_task(tried(goal)))
            await asyncio.sleep(0.02)
        results = list(await asyncio.gather(*tasks))
        errors = [result for result in results if isinstance(result, ServobusError) and not isinstance(result, NotEnabled)]
        if not errors:
            figures.broken.append("a stream to a dead servo heard of no failure")
        if len(errors) < 2 or results.index(errors[0]) > 60:
            figures.broken.append("a stream to a dead servo heard of the failure late or once")


RULES = [
    ("start writes nothing", start, ALL, 200),
    ("1 enable outside the stored limits", enable_outside_limits, SMS, 40),
    ("1 enable and goals in each mode", enable_in_mode, MODES, 110),
    ("1 speed in the servo's unit", speed_unit, SMS, 40),
    ("3 a stranger", stranger, SMS, 80),
    ("4 restart of 0 to 2 s", restart, WITHOUT_POLLS, 1000),
    ("5 effort does not outlive its goal", effort, [case for case in SMS if case.model in ("sts", "sms")], 20),
    ("c led servo that did not hear", lead_setpoints, [KST, FULL_DUPLEX], 200),
    ("d torque that is gone", torque_lost, SMS, 200),
    ("e one reading believed", one_reading, SMS, 200),
    ("h a motion cut short", cut_motion, ALL, 140),
    ("h a stream to a dead servo", dead_stream, ALL, 14),
]
