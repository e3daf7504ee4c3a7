"""How a FEETECH line is stopped: by the rule of the mode each servo is in, confirmed by reading the effect."""

from __future__ import annotations

from itertools import product
from typing import Literal

import pytest

from servobus.protocols.sms.codec import Instruction, Packet
from servobus.values import Goal, StopReport, StopTarget
from tests.protocols.sms.bench import TWO, Bench, meddle
from tests.protocols.sms.states import FAMILIES, MODES, moving, put, travel

WRITES = (Instruction.WRITE, Instruction.REG_WRITE, Instruction.SYNC_WRITE)


def target(
    servo: str,
    kind: Literal["hold", "limp"] = "hold",
    *,
    enabled: bool = True,
    position: float | None = None,
    reachable: bool = True,
    energised: bool = False,
) -> StopTarget:
    return StopTarget(servo, kind, enabled=enabled, position=position, reachable=reachable, energised=energised)


def stop(bench: Bench, *targets: StopTarget) -> dict[str, StopReport]:
    bench.sent.clear()
    return bench.run(bench.driver.stop(targets))


# Each mode by its own rule


@pytest.mark.parametrize("when", ["identified in this mode", "mode changed since"])
@pytest.mark.parametrize("kind", ["hold", "limp"])
@pytest.mark.parametrize(("family", "mode"), MODES)
def test_a_confirmed_stop_stands_still(family: str, mode: str, kind: Literal["hold", "limp"], when: str) -> None:
    bench = Bench({"a": {"id": 1, "model": family}})
    if when == "mode changed since":
        bench.run(bench.driver.identify("a"))
    device = moving(bench, mode)
    if when == "identified in this mode":
        bench.run(bench.driver.identify("a"))
    bench.now = 0.5
    report = stop(bench, target("a", kind, enabled=False))["a"]
    assert (report.action, report.written, report.confirmed) == (kind, True, True), report
    assert travel(bench, device) == 0
    assert bool(bench.register(1, "torque_enable")) is (kind == "hold")


@pytest.mark.parametrize(("family", "mode"), MODES)
def test_what_is_not_read_back_is_not_confirmed(family: str, mode: str) -> None:
    """Every write is lost, and every one that has a reply is acknowledged by somebody."""
    bench = Bench({"a": {"id": 1, "model": family}})
    device = moving(bench, mode)
    bench.run(bench.driver.identify("a"))
    bench.now = 0.5
    bench.is_lost = lambda packet: packet.code in WRITES
    report = stop(bench, target("a", enabled=False))["a"]
    assert not report.confirmed
    assert report.detail
    assert travel(bench, device) > 0


@pytest.mark.parametrize(("family", "mode"), MODES)
def test_a_hold_never_energises(family: str, mode: str) -> None:
    bench = Bench({"a": {"id": 1, "model": family}})
    device = moving(bench, mode)
    bench.run(bench.driver.identify("a"))
    put(device, "torque_enable", 0)
    report = stop(bench, target("a", enabled=False))["a"]
    assert (report.action, report.confirmed) == ("none", True)
    assert bench.register(1, "torque_enable") == 0
    assert travel(bench, device) == 0


@pytest.mark.parametrize("family", ["sts", "sms"])
def test_a_servo_in_step_mode_that_does_not_rest_goes_limp(family: str) -> None:
    bench = Bench({"a": {"id": 1, "model": family}})
    device = moving(bench, "step")
    bench.run(bench.driver.identify("a"))
    goal = device.memory.registers["goal_position"].address

    def ignored(packet: Packet) -> bool:
        bench.now += 0.05
        return packet.code == Instruction.SYNC_WRITE and packet.params[0] == goal

    bench.is_lost = ignored
    report = stop(bench, target("a", enabled=False))["a"]
    assert (report.action, report.confirmed) == ("limp", True)
    assert "step mode" in report.detail
    assert travel(bench, device) == 0


@pytest.mark.parametrize(
    ("family", "why"),
    [
        *product(FAMILIES, ["not identified", "another family", "unknown"]),
        *((family, "a mode without a name") for family in FAMILIES if family != "scs"),  # its limits tell its mode
    ],
)
def test_a_servo_whose_mode_is_not_known_goes_limp_and_the_report_says_why(family: str, why: str) -> None:
    bench = Bench({"a": {"id": 1, "model": family}})
    device = moving(bench, "position")
    if why == "a mode without a name":
        device.memory.data[device.model.registers["mode"].address] = 9
    elif why == "another family":
        device.pose_as(*((0, 9, 3) if family != "sts" else (0, 8, 44)))
    elif why == "unknown":
        device.pose_as(0, 10, 5)
    if why != "not identified":
        bench.run(bench.driver.identify("a"))
    report = stop(bench, target("a", enabled=False))["a"]
    assert (report.action, report.confirmed) == ("limp", True)
    assert "it cannot be held" in report.detail
    assert bench.register(1, "torque_enable") == 0


# Positions


@pytest.mark.parametrize("family", FAMILIES)
def test_a_hold_is_what_was_just_read_and_never_an_estimate(family: str) -> None:
    bench = Bench({"a": {"id": 1, "model": family, "unit": "step"}})
    bench.enable()
    bench.move({"a": Goal("position", 300, speed=100)})
    bench.now = 1.0
    assert stop(bench, target("a", position=250.0))["a"] == StopReport("hold", True, True)
    assert bench.register(1, "goal_position") == bench.devices[1].model.zero + 100
    assert travel(bench, bench.devices[1]) == 0


def test_a_round_reads_anew_and_repeats_no_old_position() -> None:
    bench = Bench()
    bench.enable("a")
    bench.move({"a": Goal("position", 90, speed=90)})
    lost = [True, True]

    def slow(packet: Packet) -> bool:
        bench.now += 0.1
        return packet.code == Instruction.SYNC_WRITE and bool(lost) and lost.pop()

    bench.is_lost = slow
    assert stop(bench, target("a"))["a"].confirmed
    assert travel(bench, bench.devices[1]) < 1
    frames = [packet.frame for packet in bench.sent if packet.code == Instruction.SYNC_WRITE]
    assert len(frames) == 2 * len(set(frames)) > 2, "each is sent twice, and the next round has another"


def test_sts_are_read_and_held_by_one_frame_each() -> None:
    bench = Bench()
    bench.enable()
    reports = stop(bench, target("a", position=0.0), target("b", position=0.0))
    assert bench.instructions() == ["SYNC_READ", "SYNC_WRITE", "SYNC_WRITE", "SYNC_READ"]
    assert all(report == StopReport("hold", True, True) for report in reports.values())


@pytest.mark.parametrize("family", ["sms", "sms_cl", "scs"])
def test_the_others_are_each_held_straight_after_they_are_read(family: str) -> None:
    bench = Bench({"a": {"id": 1, "model": family}, "b": {"id": 2, "model": family}})
    bench.enable()
    stop(bench, target("a", position=0.0), target("b", position=0.0))
    assert bench.instructions() == ["READ", "SYNC_WRITE", "SYNC_WRITE"] * 2 + ["READ"] * 2


def test_torque_off_and_rest_leave_before_any_question() -> None:
    bench = Bench({**TWO, "c": {"id": 3, "model": "sts"}})
    moving(bench, "velocity", 2)
    moving(bench, "pwm", 3)
    for name in ("b", "c"):
        bench.run(bench.driver.identify(name))
    bench.enable("a")
    stop(bench, target("a", "limp"), target("b"), target("c", enabled=False))
    assert bench.instructions()[:6] == ["SYNC_WRITE"] * 6
    assert [packet.params[0] for packet in bench.sent[:6]] == [40, 40, 46, 46, 44, 44]
    assert bench.instructions()[6:] == ["SYNC_READ"]


def test_a_position_outside_the_goal_register_is_not_written() -> None:
    bench = Bench()
    bench.enable()
    assert stop(bench, target("a", position=1e6))["a"].confirmed
    assert stop(bench, target("a", position=1e6, reachable=False))["a"].written is False


# Limp servos


def test_limp_is_confirmed_by_the_torque() -> None:
    bench = Bench()
    bench.enable()
    reports = stop(bench, target("a", position=0.0), target("b", "limp"))
    assert (reports["b"].action, reports["b"].confirmed) == ("limp", True)
    assert (bench.register(1, "torque_enable"), bench.register(2, "torque_enable")) == (1, 0)


def test_torque_that_stays_on_is_reported() -> None:
    bench = Bench()
    bench.enable()
    device = bench.devices[1]
    bench.is_unanswered = meddle(device, 1)
    assert stop(bench, target("a", "limp"))["a"] == StopReport("limp", True, False, "torque still reads on")


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("how", ["restarted", "tripped"])
def test_a_servo_that_lost_its_torque_is_not_energised(family: str, how: str) -> None:
    bench = Bench({"a": {"id": 1, "model": family}})
    bench.enable()
    device = bench.devices[1]
    device.restart(0.0) if how == "restarted" else device.trip(0.0)
    why = "it has restarted" if how == "restarted" else "its torque is off, and not by us"
    assert stop(bench, target("a"))["a"] == StopReport("none", False, True, f"it was limp: {why}")
    assert bench.register(1, "torque_enable") == 0


# Many, nobody, and previews


def test_many_are_split_as_goals_are() -> None:
    bench = Bench({f"s{number}": {"id": number, "model": "sts"} for number in range(1, 81)})
    bench.enable()
    reports = stop(bench, *(target(name, "limp") for name in bench.driver.nodes))
    frames = [packet.frame for packet in bench.sent if packet.code == Instruction.SYNC_WRITE]
    assert len(frames) == 2 * 2
    assert max(map(len, frames)) <= 128
    assert all(report.confirmed for report in reports.values())
    assert not any(bench.register(number, "torque_enable") for number in range(1, 81))


def test_nobody_to_stop() -> None:
    assert stop(Bench(TWO)) == {}


@pytest.mark.parametrize("family", FAMILIES)
def test_a_preview_has_the_frames_of_a_stop(family: str) -> None:
    bench = Bench({"a": {"id": 1, "model": family}})
    targets = [target("a", position=0.0)]
    frames = [request.frame for request in bench.driver.preview_stop(targets)]
    limp = [request.frame for request in bench.driver.preview_stop([target("a", "limp")])]
    assert bench.sent == []
    bench.enable()
    stop(bench, *targets)
    assert frames == [packet.frame for packet in bench.sent[: len(frames)]]
    stop(bench, target("a", "limp"))
    assert limp == [packet.frame for packet in bench.sent[: len(limp)]]
