"""How a FEETECH line is stopped: what is sent at once, what is asked, and that a limp servo is never energised."""

from __future__ import annotations

from typing import Literal

import pytest

from servobus.protocols.sms.codec import Instruction
from servobus.values import Goal, StopReport, StopTarget
from tests.protocols.sms.bench import TWO, Bench, meddle


def target(
    servo: str,
    kind: Literal["hold", "limp"] = "hold",
    *,
    enabled: bool = True,
    position: float | None = None,
    reachable: bool = True,
) -> StopTarget:
    return StopTarget(servo, kind, enabled=enabled, position=position, reachable=reachable)


def stop(bench: Bench, *targets: StopTarget) -> dict[str, StopReport]:
    bench.sent.clear()
    return bench.run(bench.driver.stop(targets))


def test_positions_are_written_to_all_at_once_and_twice() -> None:
    bench = Bench()
    bench.enable()
    reports = stop(bench, target("a", position=10.0), target("b", position=-10.0))
    assert bench.instructions()[:2] == ["SYNC_WRITE", "SYNC_WRITE"]
    assert bench.sent[0].frame == bench.sent[1].frame
    assert bench.instructions()[2:] == ["READ", "READ", "WRITE"] * 2, "each is asked whether and where it stands, and held there"
    assert all((report.action, report.written, report.confirmed) == ("hold", True, True) for report in reports.values())
    assert bench.register(1, "goal_position") == 2048


def test_a_moving_servo_stands() -> None:
    bench = Bench()
    bench.enable()
    bench.move({"a": 90})
    bench.now = 0.3
    stop(bench, target("a"))
    bench.now = 10.0
    assert bench.ask(bench.driver.read_state("a"))["a"]["position"] == pytest.approx(0.3 * 1000 * 360 / 4096, abs=0.2)


def test_limp_first_and_confirmed() -> None:
    bench = Bench()
    bench.enable()
    reports = stop(bench, target("a", position=0.0), target("b", "limp"))
    assert bench.instructions()[:4] == ["SYNC_WRITE"] * 4
    assert (reports["b"].action, reports["b"].confirmed) == ("limp", True)
    assert (bench.register(1, "torque_enable"), bench.register(2, "torque_enable")) == (1, 0)


def test_a_limp_servo_stays_limp() -> None:
    bench = Bench()
    reports = stop(bench, target("a", enabled=False, position=5.0), target("b", enabled=False))
    assert bench.instructions() == ["READ", "READ"]
    assert all((report.action, report.confirmed) == ("none", True) for report in reports.values())
    assert bench.register(1, "torque_enable") == 0


def test_a_servo_energised_by_others_is_held() -> None:
    bench = Bench()
    device = bench.devices[1]
    device.memory.put(device.memory.registers["torque_enable"], 1)
    assert stop(bench, target("a", enabled=False))["a"] == StopReport("hold", True, True)


def test_a_wheel_stops_turning() -> None:
    bench = Bench()
    device = bench.devices[1]
    device.memory.store(device.memory.registers["mode"], 1)
    bench.run(bench.driver.identify("a"))
    bench.enable()
    bench.move({"a": Goal("velocity", 90)})
    assert stop(bench, target("a", position=3.0))["a"].confirmed
    assert bench.register(1, "goal_speed") == 0


def test_an_offline_servo_is_written_to_without_waiting() -> None:
    bench = Bench()
    bench.enable()
    reports = stop(bench, target("a", position=0.0, reachable=False), target("b", "limp", reachable=False))
    assert set(bench.instructions()) == {"SYNC_WRITE"}
    assert reports["a"] == StopReport("hold", True, False, "offline: nothing was confirmed")
    assert reports["b"].written


def test_a_silent_servo_does_not_delay_the_others() -> None:
    bench = Bench()
    bench.enable()
    bench.is_lost = lambda packet: packet.id == 1
    reports = stop(bench, target("a"), target("b"))
    assert (reports["a"].written, reports["a"].confirmed) == (False, False)
    assert "no answer" in reports["a"].detail
    assert reports["b"].confirmed


def test_torque_that_stays_on_is_reported() -> None:
    bench = Bench()
    bench.enable()
    device = bench.devices[1]
    bench.is_unanswered = meddle(device, 1)
    assert stop(bench, target("a", "limp"))["a"] == StopReport("limp", True, False, "torque still reads on")


def test_a_restarted_servo_is_not_energised() -> None:
    bench = Bench()
    bench.enable()
    bench.devices[1].reboot(0.0)
    bench.now = 10.0
    assert stop(bench, target("a"))["a"] == StopReport("none", False, True, "it was limp: it has restarted")
    assert bench.register(1, "torque_enable") == 0


def test_each_servo_is_asked_before_any_is_asked_again() -> None:
    bench = Bench()
    bench.enable()
    bench.is_lost = lambda packet: packet.id == 1
    stop(bench, target("a"), target("b"))
    ids = [packet.id for packet in bench.sent if packet.id != 0xFE]
    assert ids.index(2) == 1, "the dead one costs the live one a single question"
    assert ids.count(1) == 3


def test_without_acknowledgements_a_hold_is_read_back() -> None:
    bench = Bench(status_return="read_only")
    bench.enable()
    assert stop(bench, target("a"))["a"] == StopReport("hold", True, True)
    bench.is_lost = lambda packet: packet.code == Instruction.WRITE
    bench.devices[1].joint.position = 99.0
    assert stop(bench, target("a"))["a"] == StopReport("hold", True, False, "goal_position does not read back")


def test_a_position_outside_the_goal_register_is_read() -> None:
    bench = Bench()
    bench.enable()
    reports = stop(bench, target("a", position=1e6))
    assert "SYNC_WRITE" not in bench.instructions()
    assert reports["a"].confirmed


def test_many_are_split_as_goals_are() -> None:
    bench = Bench({f"s{number}": {"id": number, "model": "sts"} for number in range(1, 81)})
    bench.enable()
    stop(bench, *(target(name, "limp") for name in bench.driver.nodes))
    frames = [packet.frame for packet in bench.sent if packet.code == Instruction.SYNC_WRITE]
    assert len(frames) == 2 * 2
    assert max(map(len, frames)) <= 128
    assert not any(bench.register(number, "torque_enable") for number in range(1, 81))


def test_nobody_to_stop() -> None:
    assert stop(Bench(TWO)) == {}


def test_a_preview_of_a_stop_ends_at_the_first_reply() -> None:
    bench = Bench()
    targets = [target("a", position=10.0), target("b", position=-10.0)]
    frames = [request.frame for request in bench.driver.preview_stop(targets)]
    bench.enable()
    stop(bench, *targets)
    assert frames == [packet.frame for packet in bench.sent[:2]]
    assert [request.node for request in bench.driver.preview_stop([target("a"), target("b")])] == [1, 2], "a question to each"
