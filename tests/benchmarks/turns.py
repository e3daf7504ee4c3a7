"""Reads of two bytes over a PTY: servobus beside a loop in C, a loop in Python, rustypot and feetech-servo-sdk."""

from __future__ import annotations

import asyncio
import os
import tempfile
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from time import perf_counter

import rustypot
import scservo_sdk
import uvloop

import servobus
from servobus import Rig, Servo
from tests.benchmarks.regime import WARM_UP_S, Client, Line, Meter, Sample, c_loop, measured, repeated, sms_line
from tests.benchmarks.report import Report, Row, Target

BAUDRATE = 1_000_000
CALLERS = 12
READ_POSITION = bytes.fromhex("ff ff 01 04 02 38 02 be")
"""READ of 2 bytes at 56, the present position of servo 1."""
REPLY_SIZE = 8
TIMEOUT_S = 1.0
LOOPS: dict[str, Callable[[], asyncio.AbstractEventLoop]] = {"asyncio": asyncio.new_event_loop, "uvloop": uvloop.new_event_loop}


def python_loop(line: Line, seconds: float) -> Sample:
    """Blocking write and read on the descriptor without any check: the floor of the language."""
    descriptor = os.open(line.port, os.O_RDWR | os.O_NOCTTY)

    def turn() -> None:
        os.write(descriptor, READ_POSITION)
        missing = REPLY_SIZE
        while missing:
            missing -= len(os.read(descriptor, missing))

    try:
        return repeated(turn, seconds)
    finally:
        os.close(descriptor)


def rustypot_read(line: Line, seconds: float) -> Sample:
    controller = rustypot.Sts3215PyController(line.port, BAUDRATE, TIMEOUT_S)
    return repeated(lambda: controller.read_raw_present_position(1), seconds)


def sdk_read(line: Line, seconds: float) -> Sample:
    """feetech-servo-sdk, as its users call it."""
    handler = scservo_sdk.PortHandler(line.port)
    handler.openPort()
    handler.setBaudRate(BAUDRATE)
    packets = scservo_sdk.PacketHandler(0)
    try:
        return repeated(lambda: packets.read2ByteTxRx(handler, 1, 56), seconds)
    finally:
        handler.closePort()


@asynccontextmanager
async def opened(line: Line, servos: int) -> AsyncIterator[Rig]:
    """A rig of so many STS servos behind the port, `s1` and so on."""
    rows = "".join(f"      s{number}: {{id: {number}, model: sts}}\n" for number in range(1, servos + 1))
    head = f"version: 1\nbuses:\n  arm:\n    protocol: sms\n    port: {line.port}\n    baudrate: {BAUDRATE}\n    servos:\n"
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "rig.yaml"
        config.write_text(head + rows)
        async with servobus.open(config) as rig:
            yield rig


def servobus_read(callers: int, loop: str) -> Client:
    """Reads by so many tasks, each of its own servo, through the public rig."""

    def client(line: Line, seconds: float) -> Sample:
        with asyncio.Runner(loop_factory=LOOPS[loop]) as runner:
            return runner.run(_read(line, callers, seconds))

    return client


async def _read(line: Line, callers: int, seconds: float) -> Sample:
    async with opened(line, callers) as rig:
        await _callers(rig, Meter(WARM_UP_S))
        meter = Meter(seconds)
        return meter.sample(await _callers(rig, meter))


async def _callers(rig: Rig, meter: Meter) -> int:
    return sum(await asyncio.gather(*(_caller(servo, meter.end) for servo in rig)))


async def _caller(servo: Servo, end: float) -> int:
    turns = 0
    while perf_counter() < end:
        await servo.read_register("present_position", raw=True)
        turns += 1
    return turns


CLIENTS: dict[str, Client] = {
    "C loop": c_loop(READ_POSITION, REPLY_SIZE),
    "Python loop": python_loop,
    "rustypot": rustypot_read,
    "feetech-servo-sdk": sdk_read,
    **{
        f"servobus, {callers} caller{'s'[: callers > 1]}, {loop}": servobus_read(callers, loop)
        for loop in LOOPS
        for callers in (1, CALLERS)
    },
}
"""In the order in which they take turns."""


def main(seconds: float, rounds: int) -> Report:
    with sms_line() as line:
        clients = {name: client for name, client in CLIENTS.items() if line.loop or name != "C loop"}
        figures = measured(clients, line, seconds, rounds)
    floor, peer = figures.get("C loop"), figures["rustypot"]
    rows: dict[str, Row] = {
        name: {
            "turns/s": figure.turns_per_s,
            "CPU us": figure.cpu_us,
            "of the C loop": figure.turns_per_s / floor.turns_per_s if floor else None,
            "of rustypot": figure.turns_per_s / peer.turns_per_s,
            "CPU of rustypot": figure.cpu_us / peer.cpu_us,
        }
        for name, figure in figures.items()
    }
    many, one = f"servobus, {CALLERS} callers, uvloop", "servobus, 1 caller, uvloop"
    targets = [
        Target(many, "of rustypot", minimum=0.85),
        Target(many, "CPU of rustypot", maximum=1.6),
        Target(one, "of rustypot", minimum=0.75),
    ]
    return Report("READ of 2 bytes over a PTY", rows, targets)
