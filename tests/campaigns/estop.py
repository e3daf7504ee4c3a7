"""How long an e-stop takes: from the call to the last byte of the frame that stops the last servo.

The servos are witnesses on lines in memory with their wire time, so that the time of each byte is known. It is measured twice: in
real time with what the computer needs itself, and in virtual time, where the wire alone counts.
"""

from __future__ import annotations

import asyncio
import random
import statistics
from collections.abc import Awaitable, Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from servobus.cli.event_loop import loop_factory
from servobus.config.loader import parse_config
from servobus.errors import ServobusError
from servobus.rig.local import LocalRig, open_rig
from tests.campaigns.bench import tried
from tests.campaigns.witness import Sent, WitnessLine, witnessed
from tests.campaigns.witness_kst import SET_POSITION, KstLine, KstServo
from tests.campaigns.witness_sms import SYNC_WRITE, WRITE, SmsLine, SmsServo
from tests.virtual_time import VirtualLoop

SERVOS = 8
CLIENTS = 100


@dataclass(frozen=True, slots=True)
class Setting:
    """One line of the table."""

    name: str
    protocol: str
    baudrate: int
    dead_servo: bool = False
    dead_line: bool = False
    clients: int = 0


SETTINGS = (
    Setting("SMS at 1 Mbaud", "sms", 1_000_000),
    Setting("SMS at 115200", "sms", 115_200),
    Setting("KST at 512000", "kst", 512_000),
    Setting("SMS at 1 Mbaud, one servo dead", "sms", 1_000_000, dead_servo=True),
    Setting("KST at 512000, one servo dead", "kst", 512_000, dead_servo=True),
    Setting("SMS at 1 Mbaud, a second line dead", "sms", 1_000_000, dead_line=True),
    Setting(f"SMS at 1 Mbaud, {CLIENTS} busy clients", "sms", 1_000_000, clients=CLIENTS),
)


@dataclass(slots=True)
class Latency:
    """Seconds of each e-stop."""

    setting: Setting
    real: bool
    frames: list[float] = field(default_factory=list)
    """Until the last byte of the last servo's stop."""
    answers: list[float] = field(default_factory=list)
    """Until the call returned with what was confirmed."""
    unconfirmed: int = 0
    """Servos that are alive and were not confirmed."""

    def report(self) -> None:
        kind = "real time" if self.real else "wire alone"
        print(
            f"{self.setting.name:38} {kind:10} last byte {_three(self.frames)}; confirmed {_three(self.answers)} ms; "
            f"{len(self.frames)} e-stops, {self.unconfirmed} not confirmed"
        )


def _three(seconds: Sequence[float]) -> str:
    ordered = sorted(seconds)
    p99 = ordered[int(0.99 * (len(ordered) - 1))]
    return f"p50 {1e3 * statistics.median(ordered):.1f}, p99 {1e3 * p99:.1f}, max {1e3 * ordered[-1]:.1f}"


def estop(setting: Setting, times: int, *, real: bool = True) -> Latency:
    latency = Latency(setting, real)
    with asyncio.Runner(loop_factory=loop_factory() if real else VirtualLoop) as runner:
        runner.run(_campaign(latency, times))
    return latency


def _line(setting: Setting, rng: random.Random) -> WitnessLine:
    if setting.protocol == "kst":
        servos = [KstServo(number, position=300.0) for number in range(1, SERVOS + 1)]
        return KstLine(servos, baudrate=setting.baudrate, rng=rng)
    return SmsLine([SmsServo(number, "sts") for number in range(1, SERVOS + 1)], baudrate=setting.baudrate, rng=rng)


def _text(setting: Setting) -> str:
    text = "version: 1\nbuses:\n"
    for name in ("first", "second") if setting.dead_line else ("first",):
        text += f'  {name}:\n    protocol: {setting.protocol}\n    port: "witness://{name}"\n    baudrate: {setting.baudrate}\n'
        text += "    poll: {feedback: 20}\n    servos:\n"
        model = ", model: sts" if setting.protocol == "sms" else ""
        text += "".join(f"      {name[0]}{number}: {{id: {number}{model}}}\n" for number in range(1, SERVOS + 1))
    return text


async def _campaign(latency: Latency, times: int) -> None:
    setting, rng = latency.setting, random.Random(1)
    first, second = _line(setting, rng), _line(setting, rng)
    with closing(first), closing(second), witnessed(first=first, second=second):
        async with open_rig(parse_config(_text(setting), "campaign", Path())) as rig:
            for number in range(times):
                await _one(rig, first, second, latency, rng, number)


async def _one(rig: LocalRig, first: WitnessLine, second: WitnessLine, latency: Latency, rng: random.Random, number: int) -> None:
    """Enable, move, and stop in the middle of it."""
    names = [f"f{each}" for each in range(1, SERVOS + 1)]
    await rig.enable(*rig.names)
    tasks = [asyncio.create_task(tried(rig[name].move_to(30 + 20 * (-1) ** number, speed=60))) for name in rig.names]
    tasks += [asyncio.create_task(_busy(rig, names, each)) for each in range(latency.setting.clients)]
    await asyncio.sleep(rng.uniform(0.03, 0.08))
    if latency.setting.dead_servo:
        first.servos[1].deaf_until = 1e12
    second.dead = latency.setting.dead_line
    await asyncio.sleep(rng.uniform(0, 0.02))
    alive = names[latency.setting.dead_servo :]
    first.log.clear()
    began = first.clock()
    reports = await rig.stop()
    latency.answers.append(first.clock() - began)
    latency.frames.append(_last_stop(first, began) - began)
    latency.unconfirmed += sum(not reports[f"first/{name}"].confirmed for name in alive)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    first.servos[1].deaf_until, second.dead = -1.0, False
    await asyncio.sleep(0.15 if latency.setting.dead_servo or latency.setting.dead_line else 0)
    await _until(partial(_is_clear, rig))
    for name in rig.names:  # who was silent is to answer again before it is enabled
        await _until(partial(_answers, rig, name))


async def _is_clear(rig: LocalRig) -> bool:
    return await tried(rig.clear()) == ()


async def _answers(rig: LocalRig, name: str) -> bool:
    return not isinstance(await tried(rig.read(name)), ServobusError)


async def _until(condition: Callable[[], Awaitable[bool]]) -> None:
    for _ in range(200):
        if await condition():
            return
        await asyncio.sleep(0.05)
    raise AssertionError("ten seconds have not been enough")


async def _busy(rig: LocalRig, names: Sequence[str], number: int) -> None:
    rng = random.Random(number)
    while True:
        await tried(rig.read(rng.choice(names)))


def _last_stop(line: WitnessLine, began: float) -> float:
    """When the last byte of the frame left that stops the last of the living servos."""
    stopped: dict[int, float] = {}
    for sent in line.log:
        for node in _written(sent):
            if sent.time >= began and line.servos[node].deaf_until < began:
                stopped.setdefault(node, sent.time)
    return max(stopped.values(), default=began)


def _written(sent: Sent) -> list[int]:
    """The nodes to which this frame writes."""
    data = sent.data
    if data[0] == 0xFE:
        return [data[2]] if data[3] == SET_POSITION else []
    if data[4] == SYNC_WRITE:
        return list(data[7 : -1 : data[6] + 1])
    return [data[2]] if data[4] == WRITE else []
