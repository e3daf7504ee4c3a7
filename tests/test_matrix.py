"""Every verb over every kind of delivery, in memory and on a PTY: the right value, or a typed error where replies are lost."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace
from typing import Any

import pytest

from servobus.config.loader import Config
from servobus.errors import ServobusError
from servobus.rig.local import LocalRig, open_rig
from servobus.values import Outcome
from tests.simulated_rigs import config, pty_rig
from tests.virtual_time import virtual
from tests.waiting import until


@dataclass(frozen=True)
class Delivery:
    """What the line does to replies. `lossy`: a verb may end in a typed error. `patience`: more seconds that a reply may take
    on a busy machine; 0 where replies are lost."""

    faults: str
    lossy: bool = False
    echo: str = "off"
    patience: float = 0.0


MATRIX = {
    "whole": Delivery("{}", patience=0.3),
    "bytes": Delivery("{chop: bytes}", patience=0.3),
    "random": Delivery("{chop: random, seed: 7}", patience=0.3),
    "loss": Delivery("{loss: 0.2, seed: 3}", lossy=True),
    "delay": Delivery("{late: 0.2, delay_ms: 40, seed: 5}", lossy=True),
    "echo": Delivery("{echo: 1.0}", echo="auto", patience=0.3),
    "noise": Delivery("{noise: 1.0, seed: 2}"),
}

Verb = tuple[Callable[[LocalRig], Awaitable[object]], Callable[[Any], bool]]


async def clear_once_stopped(rig: LocalRig) -> tuple[str, ...]:
    """Release the e-stop when every servo has confirmed it: a stop that was lost is repeated, on each of these lines."""
    await until(lambda: not rig.buses["arm"].stops.owed)
    return await rig.clear()


VERBS: dict[str, Verb] = {
    "ping": (lambda rig: rig.ping("s1"), lambda status: status == 0),
    "identify": (lambda rig: rig.identify("s2"), lambda result: getattr(result, "model", None) == "sts"),
    "read": (lambda rig: rig.read("s1"), lambda state: abs(getattr(state, "position", 99)) < 0.1),
    "read_register": (lambda rig: rig.read_register("s2", "id"), lambda value: value == 2),
    "read_span": (lambda rig: rig.read_register("s3", "5:1"), lambda value: value == [3]),
    "write_register": (lambda rig: rig.write_register("s2", "torque_limit", 50), lambda value: value == 50),
    "persist": (lambda rig: rig.write_register("s3", "return_delay", 100, raw=True, persist=True), lambda value: value == 100),
    "scan": (lambda rig: rig.scan("arm", ids=range(5)), lambda result: [hit.id for hit in result] == [1, 2, 3]),
    "enable": (lambda rig: rig.enable(), lambda done: done is None),
    "write": (lambda rig: rig["s1"].move_to(10), lambda outcome: outcome is Outcome.ACKED),
    "sync_write": (
        lambda rig: rig.move({"s1": 5, "s2": -5}),
        # One frame, unless a servo is doubtful just then: they leave apart, and are acknowledged.
        lambda results: set(results.values()) <= {Outcome.SENT, Outcome.ACKED},
    ),
    "reg_write": (
        lambda rig: rig.move({"s1": 8, "s2": -8}, together=True, confirm=True),
        lambda results: results == {"arm/s1": Outcome.ACKED, "arm/s2": Outcome.ACKED},
    ),
    "settle": (
        lambda rig: rig.settle("s1", "s2", tolerance=0.5),
        lambda states: all(abs(abs(state.position) - 8) < 1 for state in states.values()),
    ),
    "disable": (lambda rig: rig.disable("s2"), lambda done: done is None),
    "stop": (lambda rig: rig.stop(), lambda reports: set(reports) == {"arm/s1", "arm/s2", "arm/s3"}),
    "clear": (clear_once_stopped, lambda owed: owed == ()),
}

KST_VERBS: dict[str, Verb] = {
    **{name: VERBS[name] for name in ("read", "write", "settle", "stop", "clear")},
    "ping": (lambda rig: rig.ping("s1"), lambda status: status is None),
    "identify": (lambda rig: rig.identify("s2"), lambda result: (result.model, result.firmware) == ("kst", "1.00")),
    "read_register": (lambda rig: rig.read_register("s2", "id"), lambda value: value == 2),
    "scan": (lambda rig: rig.scan("arm", ids=range(1, 5)), lambda result: [hit.id for hit in result] == [1, 2, 3]),
    "enable": VERBS["enable"],
    "sync_write": (lambda rig: rig.move({"s1": 5, "s2": -5}), lambda results: set(results.values()) == {Outcome.ACKED}),
    "reg_write": VERBS["reg_write"],
}
KST_ORDER = (
    "ping",
    "identify",
    "read",
    "read_register",
    "scan",
    "enable",
    "write",
    "sync_write",
    "reg_write",
    "settle",
    "stop",
    "clear",
)
KST_SERVOS = ("s1: {id: 1, limits: [-80, 80]}", "s2: {id: 2}", "s3: {id: 3}")
ROH_VERBS: dict[str, Verb] = {
    "ping": (lambda rig: rig.ping("s1"), lambda status: status is None),
    "identify": (lambda rig: rig.identify("s2"), lambda result: (result.model, result.firmware) == ("v2", "3.1.155")),
    "read": (lambda rig: rig.read("s1"), lambda state: state.position == 0),
    "read_register": (lambda rig: rig.read_register("s2", "node_id"), lambda value: value == 2),
    "read_span": (lambda rig: rig.read_register("s3", "1005:1"), lambda value: value == [2]),
    "write_register": (lambda rig: rig.write_register("s2", "stall_speed", 20), lambda value: value == 20),
    "persist": (lambda rig: rig.write_register("s3", "beep_switch", 0, persist=True), lambda value: value == 0),
    "scan": (lambda rig: rig.scan("arm", ids=range(1, 4)), lambda result: [hit.id for hit in result] == [2]),
    "enable": VERBS["enable"],
    "write": VERBS["write"],
    "sync_write": (lambda rig: rig.move({"s1": 45, "s2": 55}), lambda results: set(results.values()) == {Outcome.ACKED}),
    "reg_write": (
        lambda rig: rig.move({"s1": 42, "s2": 58}, together=True, confirm=True),
        lambda results: set(results.values()) == {Outcome.ACKED},
    ),
    "settle": (
        lambda rig: rig.settle("s1", "s2", tolerance=0.5),
        lambda states: all(abs(abs(state.position - 50) - 8) < 1 for state in states.values()),
    ),
    "stop": VERBS["stop"],
    "clear": VERBS["clear"],
}
ROH_SERVOS = ("s1: {id: 2, channel: index}", "s2: {id: 2, channel: middle}", "s3: {id: 2, channel: little}")
PROTOCOLS = {"sms": VERBS, "kst": {name: KST_VERBS[name] for name in KST_ORDER}, "roh": ROH_VERBS}

LOSSY: dict[str, Callable[[Any], bool]] = {
    "scan": lambda result: {hit.id for hit in result} <= {1, 2, 3},
    "sync_write": lambda results: set(results.values()) <= {Outcome.SENT, Outcome.ACKED},
    "settle": lambda states: all(not state.moving for state in states.values()),
}
"""Results that are right too where replies are lost: missing ids, goals that leave one by one, an older goal reached."""


def _config(protocol: str, delivery: Delivery) -> Config:
    keys = {"faults": delivery.faults, "echo": delivery.echo, "poll": "{feedback: 50}"}
    if protocol == "sms":
        return config(**keys)
    servos, baudrate = {"kst": (KST_SERVOS, "512000"), "roh": (ROH_SERVOS, "115200")}[protocol]
    return config(*servos, protocol=protocol, baudrate=baudrate, **keys)


async def _every_verb(rig: LocalRig, protocol: str, delivery: Delivery) -> None:
    ended = {}
    for name, (verb, right) in PROTOCOLS[protocol].items():
        async with asyncio.timeout(30):
            try:
                result = await verb(rig)
            except ServobusError:
                if not delivery.lossy:
                    raise
                ended[name] = False
            else:
                expected = LOSSY.get(name, right) if delivery.lossy else right
                assert expected(result), f"{name}: {result!r}"
                ended[name] = True
    assert ended["stop"]
    assert sum(ended.values()) > len(ended) / 2, ended


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("kind", MATRIX)
@virtual
async def test_in_memory(kind: str, protocol: str) -> None:
    async with open_rig(_config(protocol, MATRIX[kind])) as rig:
        await _every_verb(rig, protocol, MATRIX[kind])


@pytest.mark.slow
@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("kind", MATRIX)
async def test_on_a_pty(kind: str, protocol: str) -> None:
    delivery = MATRIX[kind]
    async with pty_rig(_config(protocol, delivery)) as rig:
        line = rig.buses["arm"].line
        line.traits = replace(line.traits, latency=delivery.patience)
        await _every_verb(rig, protocol, delivery)
