"""The FEETECH driver's verbs on simulated servos: what is sent, in which order, and what is refused before a frame leaves."""

from __future__ import annotations

import pytest

from servobus.errors import DeviceError, NotSupported, ReplyTimeout
from servobus.protocols.fence import choose_key
from servobus.protocols.sms.codec import Instruction
from servobus.protocols.sms.driver import FENCE_SIZES
from servobus.values import Goal, ServoGoal
from tests.protocols.sms.bench import Bench, meddle

LOCK, DELAY = 55, 7


# Enable and disable


@pytest.mark.parametrize("model", ["sms", "sms_cl", "sts", "scs"])
def test_enable_writes_the_present_position_before_torque(model: str) -> None:
    bench = Bench({"a": {"id": 1, "model": model}})
    device = bench.devices[1]
    device.joint.position = 700.0
    present = bench.run(bench.driver.enable("a"))
    zero = device.model.zero
    unit = next(iter(device.model.units.values()))
    assert present == pytest.approx((700 - zero) * unit)
    assert (bench.register(1, "goal_position"), bench.register(1, "torque_enable")) == (700, 1)
    registers = device.model.registers
    written = [packet.params[0] for packet in bench.sent if packet.code == Instruction.WRITE]
    assert written.index(registers["goal_position"].address) < written.index(registers["torque_enable"].address)
    sentinel = device.model.sentinel
    assert bench.register(1, sentinel.name) == sentinel.value != sentinel.reset


def test_enable_of_a_wheel_writes_speed_0() -> None:
    bench = Bench()
    device = bench.devices[1]
    device.memory.store(device.memory.registers["mode"], 1)
    bench.run(bench.driver.identify("a"))
    assert bench.run(bench.driver.enable("a")) is None
    assert (bench.register(1, "goal_speed"), bench.register(1, "torque_enable")) == (0, 1)
    assert bench.move({"a": Goal("velocity", -90)})
    assert bench.register(1, "goal_speed") == -1024
    with pytest.raises(NotSupported, match="is in velocity mode"):
        bench.driver.check_goal(ServoGoal("a", Goal("position", 1)))


def test_enable_that_does_not_read_back_fails() -> None:
    bench = Bench()
    bench.is_lost = lambda packet: False
    device = bench.devices[1]
    bench.is_unanswered = meddle(device, 0)
    with pytest.raises(DeviceError, match="it stays disabled"):
        bench.run(bench.driver.enable("a"))


def test_disable_reads_back() -> None:
    bench = Bench()
    bench.enable()
    report = bench.run(bench.driver.disable("a"))
    assert (report.action, report.written, report.confirmed) == ("limp", True, True)
    assert bench.register(1, "torque_enable") == 0
    device = bench.devices[1]
    bench.is_unanswered = meddle(device, 1)
    report = bench.run(bench.driver.disable("a"))
    assert (report.confirmed, report.detail) == (False, "torque still reads on")


def test_enable_asks_for_the_mode_anew() -> None:
    bench = Bench()
    device = bench.devices[1]
    device.memory.store(device.memory.registers["mode"], 1)
    assert bench.run(bench.driver.enable("a")) is None
    assert bench.register(1, "goal_speed") == 0


def test_an_enable_that_fails_half_way_ends_with_torque_off() -> None:
    bench = Bench()
    bench.is_unanswered = lambda packet: packet.code == Instruction.READ and bench.register(1, "torque_enable") == 1
    with pytest.raises(ReplyTimeout):
        bench.run(bench.driver.enable("a"))
    assert bench.register(1, "torque_enable") == 0


def test_eeprom_of_an_energised_servo_is_not_written() -> None:
    bench = Bench()
    bench.enable()
    with pytest.raises(NotSupported, match="its torque is on"):
        bench.run(bench.driver.write_register("a", "mode", 1, persist=True))
    assert bench.register(1, "mode") == 0


def test_a_lost_answer_to_the_unlock_leaves_nothing_unlocked() -> None:
    bench = Bench()
    bench.is_unanswered = lambda packet: packet.code == Instruction.WRITE and packet.params == bytes((LOCK, 0))
    with pytest.raises(ReplyTimeout):
        bench.run(bench.driver.write_register("a", "return_delay", 100, raw=True, persist=True))
    assert bench.register(1, "lock") == 1


# Fences


def test_a_fence_has_a_length_that_is_not_under_way() -> None:
    assert choose_key(FENCE_SIZES, []) == 3
    assert choose_key(FENCE_SIZES, [3, 4, 2, "x"]) == 5
    everything = [7, *[size for size in FENCE_SIZES if size != 7]]
    assert choose_key(FENCE_SIZES, everything) == 7, "the one asked longest ago"
    assert 2 not in FENCE_SIZES, "the echo of a READ has two parameters"


def test_a_fence_reads_the_id_and_the_sentinel() -> None:
    bench = Bench()
    assert bench.run(bench.driver.fence(1, [3], ()))
    assert [packet.params.hex(" ") for packet in bench.sent] == ["05 04"]
    bench.enable()
    assert bench.run(bench.driver.fence(1, [], bench.driver.nodes))
    assert [packet.params.hex(" ") for packet in bench.sent] == ["05 03", "29 01"]
    bench.devices[1].reboot(0.0)
    bench.now = 100.0
    assert not bench.run(bench.driver.fence(1, [], bench.driver.nodes)), "it has restarted"
    bench.sent.clear()
    bench.is_lost = lambda packet: True
    with pytest.raises(ReplyTimeout):
        bench.run(bench.driver.fence(1, [3], bench.driver.nodes))
    assert [packet.params[1] for packet in bench.sent] == [4, 5], "never the same length twice"


def test_an_unconfigured_servo_can_be_fenced() -> None:
    bench = Bench()
    with pytest.raises(ReplyTimeout):
        bench.run(bench.driver.fence(99, [], bench.driver.nodes))


def test_ping_and_an_unused_id() -> None:
    bench = Bench()
    assert bench.ask(bench.driver.ping(1)) == 0
    with pytest.raises(ReplyTimeout):
        bench.ask(bench.driver.unused())
    assert bench.sent[-1].id == 253
    full = Bench({f"s{number}": {"id": number, "model": "sts"} for number in range(1, 254)})
    assert full.driver.unused().node == 0
