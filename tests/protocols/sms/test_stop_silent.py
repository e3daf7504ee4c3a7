"""How a FEETECH servo that does not answer is stopped: at once, never again with an old position, and delaying nobody else."""

from __future__ import annotations

import pytest

from servobus.protocols.sms.codec import Instruction, Packet
from servobus.values import Goal, StopReport
from tests.protocols.sms.bench import Bench
from tests.protocols.sms.states import FAMILIES, MODES, moving, travel
from tests.protocols.sms.test_stop import stop, target


def test_an_offline_servo_is_written_to_without_waiting() -> None:
    bench = Bench()
    bench.enable()
    reports = stop(bench, target("a", position=0.0, reachable=False), target("b", "limp", reachable=False))
    assert bench.instructions() == ["SYNC_WRITE"] * 4
    assert reports["a"] == StopReport("hold", True, False, "offline: nothing was confirmed")
    assert reports["b"].written


@pytest.mark.parametrize("family", FAMILIES)
def test_an_offline_servo_whose_mode_is_not_known_is_said_to_go_limp(family: str) -> None:
    """Nothing else stops it whatever its mode is; "hold" would be a false word."""
    bench = Bench({"a": {"id": 1, "model": family}})
    device = moving(bench, "position")
    report = stop(bench, target("a", enabled=False, reachable=False))["a"]
    assert (report.action, report.written, report.confirmed) == ("limp", True, False)
    assert report.detail == "offline: torque off was written, and not confirmed: it cannot be held: it was not identified"
    assert travel(bench, device) == 0


@pytest.mark.parametrize("family", FAMILIES)
def test_a_silent_servo_is_held_where_it_is_taken_to_be(family: str) -> None:
    bench = Bench({"a": {"id": 1, "model": family, "unit": "step"}})
    bench.enable()
    bench.move({"a": Goal("position", 300, speed=100)})
    bench.now = 1.0
    bench.is_unanswered = lambda packet: True
    report = stop(bench, target("a", position=101.0))["a"]
    assert (report.action, report.written, report.confirmed) == ("hold", True, False)
    assert "no answer" in report.detail
    assert travel(bench, bench.devices[1]) == 1, "to the estimate"
    assert bench.instructions() == ["READ", "SYNC_WRITE", "SYNC_WRITE", "READ", "READ"], "the estimate is written once"


@pytest.mark.parametrize("family", FAMILIES)
def test_a_blind_hold_that_energised_a_restarted_servo_is_taken_back(family: str) -> None:
    bench = Bench({"a": {"id": 1, "model": family, "unit": "step"}})
    bench.enable()
    device = bench.devices[1]
    silent = [True]

    def restarts(packet: Packet) -> bool:
        if silent and packet.code == Instruction.READ:
            silent.clear()
            device.restart(bench.now)
            return True
        return False

    bench.is_lost = restarts
    report = stop(bench, target("a", position=50.0))["a"]
    assert (report.action, report.confirmed) == ("limp", True)
    assert "it had restarted" in report.detail
    assert bench.register(1, "torque_enable") == 0
    assert travel(bench, device) == 0


def test_a_silent_servo_that_was_limp_is_not_written_to() -> None:
    bench = Bench()
    bench.is_lost = lambda packet: True
    report = stop(bench, target("a", enabled=False, position=5.0))["a"]
    assert (report.written, report.confirmed) == (False, False)
    assert "no answer" in report.detail


@pytest.mark.parametrize("family", FAMILIES)
def test_a_silent_servo_delays_the_others_by_one_turn(family: str) -> None:
    bench = Bench({"a": {"id": 1, "model": family}, "b": {"id": 2, "model": family}})
    bench.enable()
    bench.devices[1].dead = True
    reports = stop(bench, target("a"), target("b", position=0.0))
    assert reports["b"].confirmed
    assert not reports["a"].confirmed
    questions = [packet.code in (Instruction.READ, Instruction.SYNC_READ) for packet in bench.sent]
    asked = [number for number, packet in enumerate(bench.sent) if questions[number] and packet.id == 1]
    if family == "sts":
        assert bench.instructions()[:4] == ["SYNC_READ", "SYNC_WRITE", "SYNC_WRITE", "READ"]
        assert len(asked) == 2, "alone from then on"
    else:
        assert bench.sent[1].id == 2
        assert len(asked) == 3


@pytest.mark.parametrize(("family", "mode"), MODES)
def test_what_may_be_said_for_ever_is_never_a_position(family: str, mode: str) -> None:
    bench = Bench({"a": {"id": 1, "model": family}})
    device = moving(bench, mode)
    unknown = bench.driver.blind_stop(target("a", enabled=False))
    assert [request.frame[5:7] for request in unknown] == [bytes((40, 1))], "torque off, until it is identified"
    bench.run(bench.driver.identify("a"))
    limp = bench.driver.blind_stop(target("a", "limp"))
    assert [request.frame[5] for request in limp] == [40]
    hold = bench.driver.blind_stop(target("a", position=5.0))
    address = {"velocity": 46, "pwm": 44, "motor": 44}.get(mode)
    assert [request.frame[5] for request in hold] == ([] if address is None else [address])
    for request in (*hold, *hold):
        bench.ask(request)
    assert (travel(bench, device) == 0) is bool(hold)
    device.restart(bench.now)
    for request in (*hold, *limp):
        bench.ask(request)
    assert bench.register(1, "torque_enable") == 0, "a servo that has restarted meanwhile stays limp"
