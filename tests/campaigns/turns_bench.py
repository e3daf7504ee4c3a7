"""Reads per second through a Rig, beside the same reads by a bare blocking loop and by feetech-servo-sdk.

Absolute figures belong to the machine; the ratios are taken in one run, in alternating rounds, in one regime: a spinner keeps one
core busy, clients and responder share the other (a core that sleeps between two turns makes every client slow by another cause).
The responder is a process that answers each READ at once from a table, so what is compared is the client's own cost.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import statistics
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import scservo_sdk
import uvloop

from servobus.config.loader import parse_config
from servobus.protocols.sms.codec import Instruction, SmsCodec, encode
from servobus.rig.opening import open_rig

BAUDRATE = 1_000_000
CALLERS = 12
POSITION = encode(1, Instruction.READ, bytes((56, 2)))
REPLY_SIZE = 8
Client = Callable[[str, float], float]
"""(port, seconds) -> reads per second."""


def respond(descriptor: int) -> None:
    """Answer each READ with zeros, and with the id where that is read."""
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    known: dict[bytes, bytes] = {}
    while True:
        request = os.read(descriptor, 4096)
        reply = known.get(request)
        if reply is None:
            reply = known[request] = b"".join(_replies(request))
        os.write(descriptor, reply)


def _replies(requests: bytes) -> Iterator[bytes]:
    codec = SmsCodec()
    codec.receive_data(requests)
    while (packet := codec.next_reply()) is not None:
        data = b""
        if packet.code == Instruction.READ:
            address, size = packet.params
            data = bytes(packet.id if address + at == 5 else 0 for at in range(size))
        yield encode(packet.id, 0, data)


def spin() -> None:
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    while True:
        pass


@contextmanager
def bench() -> Iterator[str]:
    """The path of a port with a responder behind it, in the regime described above."""
    cores = os.sched_getaffinity(0)
    master, slave = os.openpty()
    tty.setraw(slave)
    fork = multiprocessing.get_context("fork")
    helpers = [fork.Process(target=respond, args=(master,), daemon=True), fork.Process(target=spin, daemon=True)]
    for helper in helpers:
        helper.start()
    try:
        os.sched_setaffinity(0, {min(cores)})
        yield os.ttyname(slave)
    finally:
        os.sched_setaffinity(0, cores)
        for helper in helpers:
            helper.kill()
            helper.join()
        os.close(slave)
        os.close(master)


def bare(port: str, seconds: float) -> float:
    """Blocking write and read on the descriptor, nothing checked: the floor of the language."""
    descriptor = os.open(port, os.O_RDWR | os.O_NOCTTY)
    turns, end = 0, time.perf_counter() + seconds
    try:
        while time.perf_counter() < end:
            os.write(descriptor, POSITION)
            missing = REPLY_SIZE
            while missing:
                missing -= len(os.read(descriptor, missing))
            turns += 1
    finally:
        os.close(descriptor)
    return turns / seconds


def sdk(port: str, seconds: float) -> float:
    """feetech-servo-sdk, as its users call it."""
    handler = scservo_sdk.PortHandler(port)
    handler.openPort()
    handler.setBaudRate(BAUDRATE)
    packets = scservo_sdk.PacketHandler(0)
    turns, end = 0, time.perf_counter() + seconds
    try:
        while time.perf_counter() < end:
            _, result, _ = packets.read2ByteTxRx(handler, 1, 56)
            turns += result == 0
    finally:
        handler.closePort()
    return turns / seconds


def servobus(callers: int, loop_factory: Callable[[], asyncio.AbstractEventLoop]) -> Client:
    """Reads by `callers` tasks, each of its own servo, through the public Rig."""

    def client(port: str, seconds: float) -> float:
        with asyncio.Runner(loop_factory=loop_factory) as runner:
            return runner.run(_read(port, callers, seconds))

    return client


async def _read(port: str, callers: int, seconds: float) -> float:
    servos = "".join(f"      s{number}: {{id: {number}, model: sts}}\n" for number in range(1, callers + 1))
    text = f"version: 1\nbuses:\n  arm:\n    protocol: sms\n    port: {port}\n    baudrate: {BAUDRATE}\n    servos:\n{servos}"
    async with open_rig(parse_config(text, "bench", Path())) as rig:
        end = time.perf_counter() + seconds
        counts = await asyncio.gather(*(_caller(rig[f"s{number}"], end) for number in range(1, callers + 1)))
    return sum(counts) / seconds


async def _caller(servo: Any, end: float) -> int:
    turns = 0
    while time.perf_counter() < end:
        await servo.read_register("present_position", raw=True)
        turns += 1
    return turns


CLIENTS: dict[str, Client] = {
    "bare blocking loop": bare,
    "feetech-servo-sdk": sdk,
    "servobus, 1 caller, asyncio": servobus(1, asyncio.new_event_loop),
    "servobus, 12 callers, asyncio": servobus(CALLERS, asyncio.new_event_loop),
    "servobus, 1 caller, uvloop": servobus(1, uvloop.new_event_loop),
    "servobus, 12 callers, uvloop": servobus(CALLERS, uvloop.new_event_loop),
}


def main(seconds: float = 1.0, rounds: int = 5) -> dict[str, float]:
    """Print the medians; returns each client's ratio to the bare loop."""
    rates: dict[str, list[float]] = {name: [] for name in CLIENTS}
    with bench() as port:
        for _ in range(rounds):
            for name, client in CLIENTS.items():
                rates[name].append(client(port, seconds))
    medians = {name: statistics.median(found) for name, found in rates.items()}
    floor = medians["bare blocking loop"]
    print(f"{'READ of 2 bytes over a PTY':34} {'turns/s':>9} {'ratio to the bare loop':>24}")
    for name, median in medians.items():
        print(f"{name:34} {median:9.0f} {median / floor:24.2f}")
    return {name: median / floor for name, median in medians.items()}
