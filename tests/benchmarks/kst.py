"""Reads of twelve KST servos on a paced line at 512000 baud, half and full duplex, beside a bare loop of the same duplex.

The responder holds each frame for its wire time on each of two pairs of wires. It spins while it waits, so it keeps one core
busy; the client has the other. The bare loop checks nothing. It writes the next request when a reply has arrived (half duplex),
or keeps three requests under way (full duplex), which is what the line can carry.
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
from servobus.rig.local import open_rig
from tests.benchmarks.report import Report, Row, Target

BAUDRATE = 512_000
SIZE = 14
FRAME_S = SIZE * 10 / BAUDRATE
SERVOS = 12
REPLY_DELAY_S = 0.000_05
"""Between a request and its reply, the same for all servos."""
UNDER_WAY = {"half": 1, "full": 3}


def respond(descriptor: int) -> None:
    """Servos 1 to 12, with one pair of wires for requests and one for replies."""
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    os.set_blocking(descriptor, False)
    request_end = reply_end = 0.0
    replies: deque[tuple[float, bytes]] = deque()
    received = b""
    while True:
        now = time.perf_counter()
        while replies and replies[0][0] <= now:
            os.write(descriptor, replies.popleft()[1])
        try:
            received += os.read(descriptor, 4096)
        except BlockingIOError:
            continue
        while len(received) >= SIZE:
            frame, received = received[:SIZE], received[SIZE:]
            request_end = max(now, request_end) + FRAME_S
            reply_end = max(request_end + REPLY_DELAY_S, reply_end) + FRAME_S
            data = bytes((frame[2],)) if frame[3] == Command.READ_ID else bytes(2)
            replies.append((reply_end, encode(frame[2], frame[3] + 0x40, data)))


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


def servobus_read(port: str, duplex: str, seconds: float) -> float:
    """The same reads by one caller for each servo, through the public Rig on uvloop."""
    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        return runner.run(_read(port, duplex, seconds))


async def _read(port: str, duplex: str, seconds: float) -> float:
    servos = "".join(f"      k{number}: {{id: {number}}}\n" for number in range(1, SERVOS + 1))
    head = f"version: 1\nbuses:\n  line:\n    protocol: kst\n    port: {port}\n    baudrate: {BAUDRATE}\n"
    delay_ms = 1000 * REPLY_DELAY_S
    text = f"{head}    duplex: {duplex}\n    reply_delay_ms: [{delay_ms}, {delay_ms}]\n    servos:\n{servos}"
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


CLIENTS: dict[str, Callable[[str, str, float], float]] = {"bare descriptor loop": bare, "servobus, 12 callers": servobus_read}


def main(seconds: float, rounds: int) -> Report:
    """Medians; what servobus has to reach is nine tenths of the bare loop of the same duplex."""
    rates: dict[tuple[str, str], list[float]] = {}
    with line() as port:
        for _ in range(rounds):
            for duplex in UNDER_WAY:
                for name, client in CLIENTS.items():
                    rates.setdefault((duplex, name), []).append(client(port, duplex, seconds))
    rows: dict[str, Row] = {}
    for (duplex, name), samples in rates.items():
        median, floor = statistics.median(samples), statistics.median(rates[duplex, "bare descriptor loop"])
        ideal = 1 / (FRAME_S if duplex == "full" else 2 * FRAME_S + REPLY_DELAY_S)
        rows[f"{duplex} duplex, {name}"] = {"reads/s": median, "of the wire": median / ideal, "of the bare loop": median / floor}
    targets = [Target(f"{duplex} duplex, servobus, 12 callers", "of the bare loop", minimum=0.9) for duplex in UNDER_WAY]
    return Report(f"12 KST servos at {BAUDRATE} baud", rows, targets)
