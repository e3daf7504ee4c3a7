"""What the driver reads and polls, and registers it writes."""

from __future__ import annotations

from typing import Any

import pytest

from servobus.errors import DeviceError, LimitError, NotSupported, ReplyTimeout, UnknownName
from servobus.protocols.sms.codec import Instruction
from servobus.protocols.sms.requests import Read, SyncRead
from servobus.values import Goal, Loss, ServoGoal
from tests.protocols.sms.bench import TWO, Bench

LOCK, DELAY = 55, 7


# Reading


def test_read_state() -> None:
    bench = Bench({"a": {"id": 1, "model": "sts", "direction": -1}})
    bench.devices[1].joint.position = 1048.0
    update = bench.ask(bench.driver.read_state("a"))["a"]
    assert update["position"] == pytest.approx(1000 * 360 / 4096)
    assert (update["moving"], update["temperature"], update["voltage"]) == (False, 25, 12.0)
    assert bench.driver.step("a") == 360 / 4096


def test_registers_by_name_alias_and_address() -> None:
    bench = Bench()
    read = bench.driver.read_register
    assert bench.ask(read("a", "id")) == 1
    assert bench.ask(read("a", "temperature")) == bench.ask(read("a", "present_temperature")) == 25
    assert bench.ask(read("a", "position")) == 0.0
    assert bench.ask(read("a", "position", raw=True)) == 2048
    assert bench.ask(read("a", "5:1")) == bench.ask(read("a", "0x05:1")) == [1]
    assert read("a", "id") is read("a", "id"), "the same question is the same object"


@pytest.mark.parametrize("span", ["0:250", "255:1", "6:250"])
def test_spans_at_their_edges(span: str) -> None:
    assert Bench().driver.read_register("a", span).replies == 1


@pytest.mark.parametrize("span", ["256:1", "255:2", "0:0", "0:251"])
def test_spans_beyond(span: str) -> None:
    with pytest.raises(LimitError, match="give ADDR:LEN with LEN 1 to 250, inside addresses 0 to 255"):
        Bench().driver.read_register("a", span)


def test_unknown_names() -> None:
    bench = Bench()
    with pytest.raises(UnknownName, match="has no register 'speeed'"):
        bench.driver.read_register("a", "speeed")
    with pytest.raises(UnknownName, match="no servo c"):
        bench.driver.check_goal(ServoGoal("c", Goal("position", 1)))
    assert bench.driver.fault_names("a", 0b100001) == ("voltage", "overload")


# Polls


def test_sts_are_polled_by_one_sync_read_and_sms_one_by_one() -> None:
    servos = {**TWO, "c": {"id": 3, "model": "sms"}, "d": {"id": 4, "model": "sms"}}
    polls = Bench(servos).driver.polls({"feedback": 50, "health": 1})
    assert [(poll.name, poll.hz, poll.nodes) for poll in polls] == [
        ("feedback", 50, (1, 2)),
        ("feedback", 50, (3,)),
        ("feedback", 50, (4,)),
        ("health", 1, (1, 2)),
        ("health", 1, (3,)),
        ("health", 1, (4,)),
    ]


@pytest.mark.parametrize("name", ["feedback", "health"])
def test_a_poll_reads_the_reachable_servos(name: str) -> None:
    bench = Bench()
    (poll,) = bench.driver.polls({name: 10})
    both, one, none = (poll.request(nodes) for nodes in ([1, 2], [2], []))
    assert isinstance(both, SyncRead)
    assert isinstance(one, Read)
    assert none is None
    assert {servo: update["position"] for servo, update in bench.ask(both).items()} == {"a": 0.0, "b": 0.0}
    assert set(bench.ask(one)) == {"b"}


def test_a_sync_read_with_long_replies_is_split() -> None:
    servos = {f"s{number}": {"id": number, "model": "sts"} for number in range(1, 13)}
    assert [len(poll.nodes) for poll in Bench(servos).driver.polls({"feedback": 50})] == [12]
    assert [len(poll.nodes) for poll in Bench(servos, baudrate=115_200).driver.polls({"feedback": 50})] == [3, 3, 3, 3]
    assert [len(poll.nodes) for poll in Bench(servos, baudrate=9600).driver.polls({"feedback": 1})] == [1] * 12


# Writing


def test_ram_is_written_and_acknowledged() -> None:
    bench = Bench()
    assert bench.run(bench.driver.write_register("a", "torque_limit", 60)) == 60
    assert bench.run(bench.driver.write_register("a", "torque_limit", 700, raw=True)) == 700
    assert bench.instructions() == ["WRITE", "WRITE"]


def test_without_acknowledgement_it_is_read_back() -> None:
    bench = Bench(status_return="read_only")
    assert bench.run(bench.driver.write_register("a", "torque_limit", 60)) == 60
    assert bench.instructions() == ["WRITE", "READ"]
    bench.is_lost = lambda packet: packet.code == Instruction.WRITE
    with pytest.raises(DeviceError, match="reads 600 after 500 was written"):
        bench.run(bench.driver.write_register("a", "torque_limit", 50))


def test_eeprom_is_unlocked_written_locked_and_read_back() -> None:
    bench = Bench()
    assert bench.run(bench.driver.write_register("a", "return_delay", 100, raw=True, persist=True)) == 100
    assert [(packet.code, *packet.params) for packet in bench.sent] == [
        (Instruction.READ, 40, 1),
        (Instruction.WRITE, LOCK, 0),
        (Instruction.WRITE, DELAY, 100),
        (Instruction.WRITE, LOCK, 1),
        (Instruction.READ, DELAY, 1),
    ]
    bench.devices[1].reboot(0.0)
    bench.now = 10.0
    assert bench.register(1, "return_delay") == 100, "it survives a restart"


def test_a_failed_eeprom_write_is_locked_again() -> None:
    bench = Bench()
    bench.is_lost = lambda packet: packet.code == Instruction.WRITE and packet.params[0] == DELAY
    with pytest.raises(ReplyTimeout):
        bench.run(bench.driver.write_register("a", "return_delay", 100, raw=True, persist=True))
    assert bench.sent[-1].params == bytes((LOCK, 1))
    assert bench.register(1, "lock") == 1


@pytest.mark.parametrize(
    ("register", "value", "keys", "error", "message"),
    [
        ("goal_position", 1, {}, NotSupported, "use move"),
        ("goal_speed", 1, {}, NotSupported, "use move"),
        ("torque_enable", 1, {}, NotSupported, "use enable or disable"),
        ("lock", 0, {}, NotSupported, "unlocks and locks by itself"),
        ("id", 5, {"persist": True}, NotSupported, "would no longer find the servo"),
        ("baud_rate", 0, {"persist": True, "raw": True}, NotSupported, "would no longer find"),
        ("response_status_level", 0, {"persist": True}, NotSupported, "would no longer find"),
        ("return_delay", 1, {"raw": True}, NotSupported, "add persist"),
        ("present_position", 1, {}, NotSupported, "can only be read"),
        ("torque_limit", 100.1, {}, LimitError, "outside 0 to 1000"),
        ("torque_limit", -0.1, {}, LimitError, "outside 0 to 1000"),
        ("torque_limit", 1.5, {"raw": True}, LimitError, "a raw value is an integer"),
        ("torque_limit", True, {"raw": True}, LimitError, "a raw value is an integer"),
        ("torque_limit", float("nan"), {}, LimitError, "not a finite number"),
        ("acceleration", "fast", {}, LimitError, "not a finite number"),
        ("acceleration", 0, {}, LimitError, "how a restart is noticed"),
        ("nothing", 0, {}, UnknownName, "has no register"),
    ],
)
def test_registers_that_are_not_written_by_hand(
    register: str, value: Any, keys: dict[str, bool], error: type[Exception], message: str
) -> None:
    bench = Bench()
    with pytest.raises(error, match=message):
        bench.driver.write_register("a", register, value, **keys)
    assert bench.sent == []


def test_an_acceleration_written_by_hand_is_the_servos_own() -> None:
    bench = Bench()
    bench.enable()
    bench.run(bench.driver.write_register("a", "acceleration", 1000))
    assert bench.register(1, "acceleration") == 114
    bench.move({"a": Goal("position", 5, acceleration=500)})
    assert bench.register(1, "acceleration") == 57
    bench.move({"a": 5})
    assert bench.register(1, "acceleration") == 114


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("model", ["sts", "sms", "sms_cl", "scs"])
def test_stored_limits_keep_their_order_in_the_servos_unit(model: str, direction: int) -> None:
    """The lower limit of a joint that is mounted the other way round is the servo's upper one."""
    bench = Bench({"a": {"id": 1, "model": model, "direction": direction, "unit": "step"}})
    zero = bench.devices[1].model.zero
    bench.run(bench.driver.write_register("a", "min_angle_limit", -100, persist=True))
    bench.run(bench.driver.write_register("a", "max_angle_limit", 300, persist=True))
    ends = (zero - 100, zero + 300) if direction == 1 else (zero - 300, zero + 100)
    assert (bench.register(1, "min_angle_limit"), bench.register(1, "max_angle_limit")) == ends
    for name, value in (("min_angle_limit", -100), ("max_angle_limit", 300)):
        assert bench.ask(bench.driver.read_register("a", name)) == value
        assert bench.ask(bench.driver.read_register("a", name, raw=True)) == bench.register(1, name)
    assert bench.run(bench.driver.identify("a")).limits == (-100, 300)


# What tells that an enabled servo is not as it was left


@pytest.mark.parametrize("model", ["sts", "sms", "sms_cl", "scs"])
@pytest.mark.parametrize("question", ["feedback", "health", "read", "verify"])
def test_each_answer_tells_of_a_restart_and_of_lost_torque(model: str, question: str) -> None:
    bench = Bench({"a": {"id": 1, "model": model}, "b": {"id": 2, "model": model}})
    bench.enable()

    def losses() -> list[Loss | None]:
        if question == "verify":
            losses_of = bench.run(bench.driver.verify(["a", "b"]))
            return [losses_of.get(name) for name in ("a", "b")]
        if question == "read":
            return [bench.ask(bench.driver.read_state(name))[name]["loss"] for name in ("a", "b")]
        requests = [poll.request([1, 2]) for poll in bench.driver.polls({question: 1})]
        updates = {name: update for request in requests if request for name, update in bench.ask(request).items()}
        return [updates[name]["loss"] for name in ("a", "b")]

    assert losses() == [None, None]
    bench.devices[2].trip(0.0)
    assert losses() == [None, Loss.TORQUE_OFF]
    bench.devices[1].restart(0.0)
    assert losses() == [Loss.RESTARTED, Loss.TORQUE_OFF]
    assert bench.ask(bench.driver.read_state("a"))["a"]["energised"] is False


def test_verify_takes_one_turn_for_those_that_know_sync_read_and_raises_for_nobody() -> None:
    bench = Bench({**TWO, "c": {"id": 3, "model": "sms"}})
    bench.enable()
    assert bench.run(bench.driver.verify(["a", "b", "c"])) == {}
    assert bench.instructions() == ["SYNC_READ", "READ"]
    bench.devices[2].dead = bench.devices[3].dead = True
    bench.devices[1].restart(0.0)
    assert bench.run(bench.driver.verify(["a", "b", "c"])) == {"a": Loss.RESTARTED}
    assert bench.run(bench.driver.verify([])) == {}


@pytest.mark.parametrize("model", ["sts", "sms", "sms_cl"])
@pytest.mark.parametrize(("phase", "steps"), [(0, 50), (4, 1), (12, 1), (0x6C, 1), (0x48, 50)])
def test_the_unit_bit_counts_for_every_speed(model: str, phase: int, steps: int) -> None:
    """FEETECH memory table, 18: bit 2 chooses 50 steps/s or 1 step/s a count."""
    bench = Bench({"a": {"id": 1, "model": model, "unit": "step", "direction": -1}})
    device = bench.devices[1]
    device.memory.store(device.memory.registers["phase"], phase)
    bench.enable()
    bench.move({"a": Goal("position", -500, speed=300)})
    assert bench.register(1, "goal_speed") == 300 / steps
    assert bench.ask(bench.driver.read_register("a", "goal_speed")) == -300, "a speed on the way has no direction"
    update = bench.ask(bench.driver.read_state("a"))["a"]
    assert update["speed"] == bench.ask(bench.driver.read_register("a", "present_speed")) == -300
    bench.move({"a": -600})
    assert bench.register(1, "goal_speed") == 1000 / steps, "the usual speed too"


@pytest.mark.parametrize(("register", "value", "raw"), [("min_angle_limit", -90, 1024), ("max_angle_limit", 90, 3072)])
def test_positions_in_eeprom_are_in_the_servos_unit(register: str, value: float, raw: int) -> None:
    bench = Bench()
    assert bench.run(bench.driver.write_register("a", register, value, persist=True)) == value
    assert bench.register(1, register) == raw
