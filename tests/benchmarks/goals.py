"""Goals for twelve servos: `rig.move` and twelve callers of `move_to`, beside SYNC WRITE by a loop in C, rustypot and the SDK.

servobus keeps to the wire time of 1 Mbaud, which the other clients leave to the kernel: compare CPU time, not frames per second.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from itertools import cycle
from time import perf_counter

import rustypot
import scservo_sdk

from servobus import Rig, Servo
from tests.benchmarks.regime import WARM_UP_S, Client, Figure, Line, Meter, Sample, c_loop, measured, repeated, sms_line
from tests.benchmarks.report import Report, Row, Target
from tests.benchmarks.turns import BAUDRATE, CALLERS, LOOPS, TIMEOUT_S, opened

SERVOS = range(1, CALLERS + 1)
GOAL_POSITION, GOAL_SIZE = 42, 6
GOAL = bytes.fromhex("00 08 00 00 e8 03")
"""Position 2048, no time, 1000 steps/s."""
POSITIONS_DEG = (0.0, 5.0)
MOVE, STREAM = f"rig.move of {CALLERS}", f"{CALLERS} callers of move_to"


def sync_write() -> bytes:
    """The frame that every client of this file sends."""
    params = bytes((GOAL_POSITION, GOAL_SIZE)) + b"".join(bytes((servo,)) + GOAL for servo in SERVOS)
    fields = bytes((0xFE, len(params) + 2, 0x83)) + params
    return b"\xff\xff" + fields + bytes((~sum(fields) & 0xFF,))


def rustypot_write(line: Line, seconds: float) -> Sample:
    controller = rustypot.Sts3215PyController(line.port, BAUDRATE, TIMEOUT_S)
    ids, data = list(SERVOS), [list(GOAL) for _ in SERVOS]
    return repeated(lambda: controller.sync_write_raw_data(ids, GOAL_POSITION, data), seconds)


def sdk_write(line: Line, seconds: float) -> Sample:
    """feetech-servo-sdk, as its users call it."""
    handler = scservo_sdk.PortHandler(line.port)
    handler.openPort()
    handler.setBaudRate(BAUDRATE)
    group = scservo_sdk.GroupSyncWrite(handler, scservo_sdk.PacketHandler(0), GOAL_POSITION, GOAL_SIZE)
    goal = list(GOAL)

    def turn() -> None:
        for servo in SERVOS:
            group.addParam(servo, goal)
        group.txPacket()
        group.clearParam()

    try:
        return repeated(turn, seconds)
    finally:
        handler.closePort()


async def move(rig: Rig, end: float) -> int:
    """One caller, all servos at once."""
    calls, goals = 0, cycle({servo.name: position for servo in rig} for position in POSITIONS_DEG)
    while perf_counter() < end:
        await rig.move(next(goals))
        calls += 1
    return calls


async def stream(rig: Rig, end: float) -> int:
    """One caller for each servo."""
    return sum(await asyncio.gather(*(_caller(servo, end) for servo in rig)))


async def _caller(servo: Servo, end: float) -> int:
    goals, positions = 0, cycle(POSITIONS_DEG)
    while perf_counter() < end:
        await servo.move_to(next(positions))
        goals += 1
    return goals


@dataclass(slots=True)
class Filling:
    """How full the SYNC WRITE frames of one client are, over all rounds."""

    frames: int = 0
    servos: int = 0
    seconds: float = 0.0

    def add(self, before: tuple[int, int], after: tuple[int, int], seconds: float) -> None:
        self.frames += after[0] - before[0]
        self.servos += after[1] - before[1]
        self.seconds += seconds


def servobus_goals(act: Callable[[Rig, float], Awaitable[int]], loop: str, filling: Filling) -> Client:
    """So many calls through the public rig."""

    def client(line: Line, seconds: float) -> Sample:
        with asyncio.Runner(loop_factory=LOOPS[loop]) as runner:
            return runner.run(_send(line, seconds))

    async def _send(line: Line, seconds: float) -> Sample:
        async with opened(line, CALLERS) as rig:
            await rig.enable()
            await act(rig, Meter(WARM_UP_S).end)
            before, meter = line.synced(), Meter(seconds)
            sample = meter.sample(await act(rig, meter.end))
            filling.add(before, line.synced(), sample.seconds)
        return sample

    return client


def main(seconds: float, rounds: int) -> Report:
    fillings = {f"servobus, {name}, {loop}": Filling() for loop in LOOPS for name in (MOVE, STREAM)}
    clients: dict[str, Client] = {
        "C loop": c_loop(sync_write(), 0),
        "rustypot": rustypot_write,
        "feetech-servo-sdk": sdk_write,
        **{
            f"servobus, {name}, {loop}": servobus_goals(act, loop, fillings[f"servobus, {name}, {loop}"])
            for loop in LOOPS
            for name, act in ((MOVE, move), (STREAM, stream))
        },
    }
    with sms_line() as line:
        if line.loop is None:
            del clients["C loop"]
        figures = measured(clients, line, seconds, rounds)
    rows = {name: _row(name, figure, fillings.get(name)) for name, figure in figures.items()}
    moves, goals = f"servobus, {MOVE}, uvloop", f"servobus, {STREAM}, uvloop"
    full = [Target(name, "servos a frame", minimum=CALLERS - 0.1) for name in (moves, goals)]
    targets = [Target(moves, "CPU us a call", maximum=150), Target(goals, "CPU us a call", maximum=20), *full]
    return Report(f"SYNC WRITE of {GOAL_SIZE} bytes to {CALLERS} servos", rows, targets)


def _row(name: str, figure: Figure, filling: Filling | None) -> Row:
    """A call moves all servos, but for the callers of `move_to`, where it moves one."""
    servos_a_call = 1 if STREAM in name else CALLERS
    frames_per_s = filling.frames / filling.seconds if filling else figure.turns_per_s
    return {
        "calls/s": figure.turns_per_s,
        "CPU us a call": figure.cpu_us,
        "CPU us a goal": figure.cpu_us / servos_a_call,
        "frames/s": frames_per_s,
        "servos a frame": filling.servos / filling.frames if filling else float(CALLERS),
    }
