"""A poll of twelve KST servos on a paced line at 512000 baud, half and full duplex, beside a bare loop of the same duplex.

The responder holds each frame for its wire time on each of two pairs of wires, and spins for it, so it keeps one core busy; the
client has the other. The bare loop checks nothing: it writes the next question when an answer is here (half), or keeps three
questions under way (full), which is what the line can carry.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import statistics
import time
import tty
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import uvloop

from servobus.config.loader import parse_config
from servobus.protocols.kst.codec import Command, encode
from servobus.rig.interface import Servo
from servobus.rig.opening import open_rig

BAUDRATE = 512_000
SIZE = 14
FRAME = SIZE * 10 / BAUDRATE
SERVOS = 12
PAUSE = 0.000_05
"""Seconds between question and answer, the same for all."""
UNDER_WAY = {"half": 1, "full": 3}


def respond(descriptor: int) -> None:
    """Servos 1 to 12, on a wire for questions and a wire for answers."""
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    os.set_blocking(descriptor, False)
    asked_until = answered_until = 0.0
    answers: deque[tuple[float, bytes]] = deque()
    heard = b""
    while True:
        now = time.perf_counter()
        while answers and answers[0][0] <= now:
            os.write(descriptor, answers.popleft()[1])
        try:
            heard += os.read(descriptor, 4096)
        except BlockingIOError:
            continue
        while len(heard) >= SIZE:
            frame, heard = heard[:SIZE], heard[SIZE:]
            asked_until = max(now, asked_until) + FRAME
            answered_until = max(asked_until + PAUSE, answered_until) + FRAME
            data = bytes((frame[2],)) if frame[3] == Command.READ_ID else bytes(2)
            answers.append((answered_until, encode(frame[2], frame[3] + 0x40, data)))


@contextmanager
def line() -> Iterator[str]:
    """The path of a port with the servos behind it."""
    cores = os.sched_getaffinity(0)
    master, slave = os.openpty()
    tty.setraw(slave)
    tty.setraw(master)
    servos = multiprocessing.get_context("fork").Process(target=respond, args=(master,), daemon=True)
    servos.start()
    try:
        os.sched_setaffinity(0, {min(cores)})
        yield os.ttyname(slave)
    finally:
        os.sched_setaffinity(0, cores)
        servos.kill()
        servos.join()
        os.close(slave)
        os.close(master)


def bare(port: str, duplex: str, seconds: float) -> float:
    """Reads per second of a loop on the descriptor."""
    descriptor = os.open(port, os.O_RDWR | os.O_NOCTTY)
    frames = [encode(number, Command.READ_POSITION) for number in range(1, SERVOS + 1)]
    turns, end = 0, time.perf_counter() + seconds
    try:
        for under_way in range(UNDER_WAY[duplex]):
            os.write(descriptor, frames[under_way])
        missing = SIZE
        while time.perf_counter() < end:
            missing -= len(os.read(descriptor, missing))
            if not missing:
                os.write(descriptor, frames[(turns + UNDER_WAY[duplex]) % SERVOS])
                turns, missing = turns + 1, SIZE
        time.sleep(0.01)
        os.set_blocking(descriptor, False)
        while os.read(descriptor, 4096):
            pass
    except BlockingIOError:
        pass
    finally:
        os.close(descriptor)
    return turns / seconds


def servobus(port: str, duplex: str, seconds: float) -> float:
    """The same reads by one caller for each servo, through the public Rig on uvloop."""
    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        return runner.run(_read(port, duplex, seconds))


async def _read(port: str, duplex: str, seconds: float) -> float:
    servos = "".join(f"      k{number}: {{id: {number}}}\n" for number in range(1, SERVOS + 1))
    head = f"version: 1\nbuses:\n  line:\n    protocol: kst\n    port: {port}\n    baudrate: {BAUDRATE}\n"
    pause = 1000 * PAUSE
    text = f"{head}    duplex: {duplex}\n    reply_delay_ms: [{pause}, {pause}]\n    servos:\n{servos}"
    async with open_rig(parse_config(text, "bench", Path())) as rig:
        end = time.perf_counter() + seconds
        counts = await asyncio.gather(*(_caller(servo, end) for servo in rig))
    return sum(counts) / seconds


async def _caller(servo: Servo, end: float) -> int:
    turns = 0
    while time.perf_counter() < end:
        await servo.read_register("present_position", raw=True)
        turns += 1
    return turns


CLIENTS: dict[str, Callable[[str, str, float], float]] = {"bare descriptor loop": bare, "servobus, 12 callers": servobus}


def main(seconds: float = 1.0, rounds: int = 5) -> dict[str, float]:
    """Print the medians; returns servobus's ratio to the bare loop for each duplex."""
    rates: dict[tuple[str, str], list[float]] = {}
    with line() as port:
        for _ in range(rounds):
            for duplex in UNDER_WAY:
                for name, client in CLIENTS.items():
                    rates.setdefault((duplex, name), []).append(client(port, duplex, seconds))
    ratios = {}
    print(f"{'12 KST servos at 512000 baud':34} {'reads/s':>9} {'of the wire':>12} {'ratio to the bare loop':>24}")
    for (duplex, name), found in rates.items():
        median, floor = statistics.median(found), statistics.median(rates[duplex, "bare descriptor loop"])
        ideal = 1 / (FRAME if duplex == "full" else 2 * FRAME + PAUSE)
        print(f"{duplex + ' duplex, ' + name:34} {median:9.0f} {median / ideal:12.2f} {median / floor:24.2f}")
        ratios[duplex] = median / floor
    return ratios
