"""Scenarios of troubles that come together: restarts at a stop, lines that are lost, goals that wait, configs that change."""

from __future__ import annotations

import asyncio
import math
import random
from pathlib import Path
from tempfile import TemporaryDirectory

from servobus.errors import ServobusError
from servobus.rig.local import LocalRig, open_rig
from tests.campaigns.bench import ALL, AWAY, HOME, MODES, SMS, SPEED, Bench, Case, Figures, moved, tried
from tests.campaigns.scenarios_goals import sms
from tests.campaigns.scenarios_stops import check_stops, set_off
from tests.campaigns.witness import witnessed
from tests.campaigns.witness_kst import KstServo
from tests.campaigns.witness_roh import RohHand
from tests.campaigns.witness_sms import GOAL, MAX_LIMIT, MIN_LIMIT, SmsServo

LOSS = 0.1
"""Share of requests, and of replies, that are lost: a fifth of all turns."""


async def restart_and_stop(case: Case, rng: random.Random, figures: Figures) -> None:
    """A hold does not energise a servo that has restarted: at an e-stop, for a lost client, at the exit."""
    bench = Bench(case, rng, 2)
    servo = sms(bench.servos[0])
    servo.joint.gravity = 300.0
    async with bench.rig() as rig:
        await rig.enable("s1", "s2")
        await moved(rig, "s1", bench.units[AWAY], bench.units[SPEED])
        await asyncio.sleep(rng.uniform(0, 1))
        outage = rng.uniform(0, 1)
        servo.cut_power(bench.now, outage)
        bench.mark()
        await asyncio.sleep(rng.uniform(0, outage + 0.3))
        match rng.choice(["stop", "lost client", "exit"]):
            case "stop":
                await rig.stop()
                await asyncio.sleep(outage + 1)
            case "lost client":
                await rig.abandon(["line/s1", "line/s2"])
                await asyncio.sleep(outage + 1)
            case _:
                pass
    await asyncio.sleep(1.0)
    figures.energised += len(servo.energised_at)
    figures.travel += bench.travel(1)


async def owed_in_mode(case: Case, rng: random.Random, figures: Figures) -> None:
    """A servo that another program has left moving, and that does not hear the stop, is stopped when it hears again."""
    bench = Bench(case, rng, 2)
    servo = sms(bench.servos[0])
    async with bench.rig(rng.choice(["", ", on_estop: limp"])) as rig:
        await asyncio.sleep(rng.uniform(0, 0.2))
        set_off(servo, bench.now)
        back_at = servo.deaf_until = bench.now + rng.uniform(0.1, 1.5)
        await asyncio.sleep(rng.uniform(0, 0.5))
        reports = await rig.stop()
        await check_stops(bench, reports, figures)
        await asyncio.sleep(max(0.0, back_at + 1.0 - bench.now))
        figures.owed += await bench.travels_within(1.0) > 0


async def lossy_line(case: Case, rng: random.Random, figures: Figures) -> None:
    """On a line that loses a fifth of all turns every servo is stopped within two seconds."""
    bench = Bench(case, rng, 4)
    async with bench.rig() as rig:
        await rig.enable("s1", "s2", "s3", "s4")
        for servo in bench.servos:
            servo.loss = LOSS
        for number in range(1, 5):
            await moved(rig, f"s{number}", bench.units[AWAY], bench.units[SPEED] / 10)
        await asyncio.sleep(rng.uniform(0, 0.3))
        await check_stops(bench, await rig.stop(), figures)
        await asyncio.sleep(1.0)
        figures.owed += await bench.travels_within(1.0) > 0


async def lost_client(case: Case, rng: random.Random, figures: Figures) -> None:
    """The servos of a lost client are stopped, also one that did not hear it."""
    bench = Bench(case, rng, 2)
    async with bench.rig() as rig:
        await rig.enable("s1", "s2")
        for name in ("s1", "s2"):
            await moved(rig, name, bench.units[AWAY], bench.units[SPEED] / 10)
        await asyncio.sleep(rng.uniform(0.05, 0.3))
        back_at = bench.servos[0].deaf_until = bench.now + rng.choice([0.0, rng.uniform(0.1, 1.0)])
        await rig.abandon(["line/s1", "line/s2"])
        await asyncio.sleep(max(0.0, back_at - bench.now) + 1.0)
        figures.owed += await bench.travels_within(1.0) > 0


async def hold_where_it_is(case: Case, rng: random.Random, figures: Figures) -> None:
    """A hold does not send a joint back to where it was a while ago."""
    bench = Bench(case, rng, 1)
    servo = bench.servos[0]
    async with bench.rig() as rig:
        await rig.enable("s1")
        await moved(rig, "s1", bench.units[AWAY], bench.units[SPEED])
        await asyncio.sleep(rng.uniform(0.1, 0.4))
        bench.line.settle()
        before = _position(servo)
        await rig.stop()
        await asyncio.sleep(0.5)
        bench.line.settle()
        figures.travel += max(0.0, before - _position(servo) - 2)


def _position(servo: object) -> float:
    if isinstance(servo, RohHand):
        return servo.fingers[1].position
    assert isinstance(servo, SmsServo | KstServo)
    return servo.joint.position


async def unplugged(case: Case, rng: random.Random, figures: Figures) -> None:
    """Goals of a line that was lost are not sent when it is back, and a stop that was asked for meanwhile is."""
    bench = Bench(case, rng, 2)
    async with bench.rig() as rig:
        await rig.enable("s1", "s2")
        link = rig.supervisors["line"].link
        stop = rng.random() < 0.5
        if stop:
            await moved(rig, "s2", bench.units[AWAY], bench.units[SPEED] / 20)
        link.unplug()  # type: ignore[attr-defined]
        await asyncio.sleep(rng.uniform(0, 0.01))
        goal = asyncio.create_task(moved(rig, "s1", bench.units[AWAY], bench.units[SPEED]))
        await asyncio.sleep(rng.uniform(0, 0.5))
        bench.mark()
        stopping = [asyncio.create_task(rig.stop())] if stop else []
        link.plug()  # type: ignore[attr-defined]
        await asyncio.sleep(1.0)
        figures.travel += bench.travel(1)
        if not isinstance(await goal, ServobusError):
            figures.broken.append("a goal to a line that is down was taken")
        for task in stopping:
            await task
        if stop:
            await asyncio.sleep(1.0)
            figures.owed += await bench.travels_within(1.0) > 0


async def expired(case: Case, rng: random.Random, figures: Figures) -> None:
    """A goal that could not leave in its time is not sent later."""
    bench = Bench(case, rng, 2)
    async with bench.rig() as rig:
        await rig.enable("s1", "s2")
        await asyncio.sleep(0.1)
        servo = bench.servos[0]
        bench.mark()
        servo.deaf_until = bench.now + rng.uniform(0.3, 1.0)
        for number in range(5):
            asyncio.get_running_loop().create_task(moved(rig, "s1", bench.units[AWAY] + number, bench.units[SPEED]))
            await asyncio.sleep(0.02)
        await asyncio.sleep(max(0.0, servo.deaf_until - bench.now))
        figures.travel += await bench.travels_within(1.0, 1)


async def refused(case: Case, rng: random.Random, figures: Figures) -> None:
    """What is no number, is outside the limits of YAML or of the servo, or is not enabled costs no byte."""
    bench = Bench(case, rng, 2)
    high = bench.units[AWAY] + 5
    if case.protocol == "sms":
        servo = sms(bench.servos[0])
        servo.put(MIN_LIMIT, servo.family.steps // 2 - 300)
        servo.put(MAX_LIMIT, servo.family.steps // 2 + 300)
    async with bench.rig(f", limits: [{bench.units[HOME] - 10}, {high}]") as rig:
        await tried(rig.enable("s1"))
        bench.mark()
        values = [math.nan, math.inf, high + 1, bench.units[HOME] - 11]
        values += [bench.units[AWAY]] if case.model in ("sts", "sms", "sms_cl") else []  # beyond the servo's own
        for value in values:
            if not isinstance(await moved(rig, "s1", value, bench.units[SPEED]), ServobusError):
                figures.broken.append(f"{value} was sent")
        if not isinstance(await moved(rig, "s2", bench.units[AWAY], bench.units[SPEED]), ServobusError):
            figures.broken.append("a servo that is not enabled was sent a goal")
        await asyncio.sleep(0.3)
        figures.travel += bench.travel()


async def armed_stranger(case: Case, rng: random.Random, figures: Figures) -> None:
    """A node that only a scan has seen, or a member, is not fired either."""
    bench = Bench(case, rng, 3)
    extra = SmsServo(9, case.model)
    bench.line.servos[9] = extra
    victim = rng.choice([extra, sms(bench.servos[0]), sms(bench.servos[2])])
    victim.armed = GOAL, bytes(6)
    async with bench.rig() as rig:
        await rig.scan("line", ids=[9])
        for first, second in (("s1", "s2"), ("s2", "s3")):
            await tried(rig.enable(first, second))
            await asyncio.sleep(rng.uniform(0, 0.1))
            if not victim.fired and not victim.energised_at:
                bench.mark()
            here = bench.units[HOME] + 5
            await tried(rig.move({first: here, second: here}, together=True, confirm=True))
            await asyncio.sleep(0.2)
    await asyncio.sleep(0.5)
    figures.fired += abs(victim.joint.position - victim.family.steps / 2) > victim.family.steps / 8


async def reload(case: Case, rng: random.Random, figures: Figures) -> None:
    """A config that is read again moves nobody, and takes no torque away."""
    bench = Bench(case, rng, 2)
    with TemporaryDirectory() as folder, witnessed(line=bench.line):
        path = Path(folder) / "rig.yaml"
        path.write_text(bench.text())
        async with open_rig(path) as rig:
            await rig.enable("s1", "s2")
            await asyncio.sleep(0.2)
            bench.mark()
            change = rng.choice(["rate", "limits", "line", "invalid"])
            path.write_text(_changed(bench, change))
            await _reload_and_try(rig, change, figures)
            figures.travel += bench.travel()


def _changed(bench: Bench, change: str) -> str:
    """The config, changed in what a running bus takes, in what it cannot take, or to what is refused."""
    text = bench.text()
    match change:
        case "rate":
            return text.replace("feedback: 50", "feedback: 40")
        case "limits":
            return bench.text((f", limits: [{bench.units[HOME] - 20}, {bench.units[HOME] + 20}], max_speed: 50",))
        case "line":
            return text.replace("    port:", "    timeout_ms: 50\n    port:")
        case _:
            return text.replace("protocol", "protocoll")


async def _reload_and_try(rig: LocalRig, change: str, figures: Figures) -> None:
    result = await tried(rig.reload())
    if isinstance(result, ServobusError) is (change in ("rate", "limits")):
        figures.broken.append(f"{change}: {result}")
    await asyncio.sleep(0.5)
    for name in ("s1", "s2"):
        if not (await rig.read(name)).enabled:
            figures.broken.append(f"{change}: a servo is not enabled any more")


RULES = [
    ("3 what is refused costs no byte", refused, ALL, 70),
    ("4 restart, then a stop or the exit", restart_and_stop, SMS, 200),
    ("6 reload of a running bus", reload, ALL, 140),
    ("a armed: a member, or one of a scan", armed_stranger, SMS, 100),
    ("b a stop is owed to what others move", owed_in_mode, MODES, 220),
    ("b a stop on a lossy line", lossy_line, ALL, 240),
    ("b a lost client's stop is owed", lost_client, ALL, 140),
    ("f goals that could not leave", expired, ALL, 140),
    ("f a line that was lost", unplugged, ALL, 140),
    ("h a hold is where the joint is", hold_where_it_is, ALL, 140),
]
