"""What an e-stop of FEETECH servos believes: no single reading that surprises, and no goal that the joint cannot keep."""

from __future__ import annotations

import pytest

from servobus.protocols.sms.codec import Instruction, Packet
from tests.protocols.sms.bench import Bench
from tests.protocols.sms.states import FAMILIES, MODES, moving, put, travel
from tests.protocols.sms.test_stop import stop, target


@pytest.mark.parametrize("estimate", [0.0, None])
@pytest.mark.parametrize("family", FAMILIES)
def test_one_altered_position_is_not_held(family: str, estimate: float | None) -> None:
    """Its checksum is right, so only another reading can tell."""
    bench = Bench({"a": {"id": 1, "model": family}})
    bench.enable()
    device = bench.devices[1]
    position, altered = device.joint.position, [900.0]

    def once(packet: Packet) -> bool:
        device.joint.position = altered.pop() if altered and packet.code != Instruction.SYNC_WRITE else position
        return False

    bench.is_lost = once
    report = stop(bench, target("a", position=estimate))["a"]
    assert report.confirmed
    assert not altered
    written = [packet.params for packet in bench.sent if packet.code == Instruction.SYNC_WRITE]
    register = device.memory.registers["goal_position"]
    assert {register.decode(params[3:5], device.model.byte_order) for params in written} == {round(position)}


@pytest.mark.parametrize("enabled", [True, False])
@pytest.mark.parametrize("altered", ["torque", "mode"])
@pytest.mark.parametrize(("family", "mode"), MODES)
def test_one_altered_reading_confirms_no_stop(family: str, mode: str, altered: str, *, enabled: bool) -> None:
    """Torque reads 0, or the mode reads as another, once, with a right checksum."""
    bench = Bench({"a": {"id": 1, "model": family}})
    device = moving(bench, mode)
    bench.run(bench.driver.identify("a"))
    bench.now = 0.5
    address = device.model.registers[{"torque": "torque_enable", "mode": device.model.mode_registers[0]}[altered]].address
    right, reads = device.memory.data[address], [1]

    def once(packet: Packet) -> bool:
        first = packet.code == Instruction.READ and bool(reads and reads.pop())
        device.memory.data[address] = (0 if altered == "torque" else 2 if right != 2 else 0) if first else right
        return False

    bench.is_lost = once
    report = stop(bench, target("a", enabled=enabled, energised=True, position=0.0))["a"]
    assert not reads
    assert (report.action, report.confirmed) == ("hold", True), report
    assert travel(bench, device) == 0
    assert bench.register(1, "torque_enable") == 1


def test_readings_that_differ_each_time_confirm_no_stop() -> None:
    bench = Bench({"a": {"id": 1, "model": "sts"}})
    device = moving(bench, "position")
    bench.run(bench.driver.identify("a"))

    def noise(packet: Packet) -> bool:
        device.memory.data[33] = len(bench.sent) % 4 + 1
        return False

    bench.is_lost = noise
    report = stop(bench, target("a"))["a"]
    assert not report.confirmed
    assert report.detail == "mode and torque read differently each time"


@pytest.mark.parametrize("side", ["below", "above"])
@pytest.mark.parametrize("family", FAMILIES)
def test_a_joint_outside_its_stored_limits_cannot_be_held_and_goes_limp(family: str, side: str) -> None:
    """Firmware takes any goal, and drives the joint to the nearest limit."""
    bench = Bench({"a": {"id": 1, "model": family}})
    device = bench.devices[1]
    inside = (600, 900) if side == "below" else (100, 300)
    for name, raw in zip(("min_angle_limit", "max_angle_limit"), inside, strict=True):
        put(device, name, raw)
    device.joint.position = 450.0
    put(device, "goal_speed", 20)
    put(device, "goal_position", 450)
    assert device.joint.velocity != 0
    bench.run(bench.driver.identify("a"))
    bench.now = 0.1
    report = stop(bench, target("a", enabled=False))["a"]
    assert (report.action, report.confirmed) == ("limp", True)
    assert "outside its own stored limits" in report.detail
    assert travel(bench, device) == 0


@pytest.mark.parametrize("family", FAMILIES)
def test_a_joint_a_little_beyond_a_limit_is_held_at_the_limit(family: str) -> None:
    bench = Bench({"a": {"id": 1, "model": family}})
    device = bench.devices[1]
    put(device, "min_angle_limit", 470)
    put(device, "goal_speed", 1)
    device.joint.position = 450.0
    put(device, "goal_position", 450)
    bench.run(bench.driver.identify("a"))
    report = stop(bench, target("a", enabled=False))["a"]
    assert (report.action, report.confirmed) == ("hold", True)
    assert bench.register(1, "goal_position") == 470
