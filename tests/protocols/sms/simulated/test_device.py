"""The simulated FEETECH servo against the documents: who answers what, and every instruction ."""

from __future__ import annotations

import pytest

from servobus.protocols.sms.codec import BROADCAST_ID, Instruction, encode
from servobus.protocols.sms.model import packaged_models
from servobus.protocols.sms.options import SmsBus
from servobus.protocols.sms.simulated.device import SmsDevice, devices
from tests.protocols.sms.single_servo import FAMILIES, Master, master_of, model_of, packet_of


@pytest.fixture(params=FAMILIES)
def master(request: pytest.FixtureRequest) -> Master:
    return master_of(request.param)


# Who answers what


def test_ping_is_answered_with_the_health_byte(master: Master) -> None:
    """SMS 1.0, example 1 (PING), and a health byte of five bits."""
    assert (reply := master.send(Instruction.PING)) is not None
    assert reply.frame.hex(" ").upper() == "FF FF 01 02 00 FC"
    master.device.faults = 0x25
    assert (reply := master.send(Instruction.PING)) is not None
    assert (reply.id, reply.code, reply.params) == (1, 0x25, b"")


def test_the_health_byte_is_in_every_reply_and_in_register_65(master: Master) -> None:
    """Every reply has the fault."""
    master.device.faults = 4
    assert master.read("servo_status") == 4
    reply = master.send(Instruction.READ, b"\x05\x01")
    assert reply is not None
    assert (reply.code, reply.params) == (4, b"\x01")


def test_document_example_2_reads_1304() -> None:
    """The READ example of SMS 1.0 comes from a servo at 1304."""
    reply = master_of("sms", position=1304).send(Instruction.READ, b"\x38\x02")
    assert reply is not None
    assert reply.frame.hex(" ").upper() == "FF FF 01 04 00 18 05 DD"


def test_other_ids_are_ignored(master: Master) -> None:
    """Only its own id and the broadcast id count."""
    assert master.send(Instruction.PING, to=2) is None


@pytest.mark.parametrize("code", [c for c in Instruction if c not in (Instruction.PING, Instruction.SYNC_READ)])
def test_a_broadcast_is_not_answered(master: Master, code: int) -> None:
    """SMS 1.0, 1.1: only PING is answered."""
    assert master.send(code, b"\x05\x01", to=BROADCAST_ID) is None
    assert master.send(Instruction.PING, to=BROADCAST_ID) is not None


def test_a_broadcast_ping_is_answered_in_turn_by_newer_servos() -> None:
    """By id, so that a whole line can be asked at once; servos of SMS 1.0 collide."""
    everybody = packet_of(encode(BROADCAST_ID, Instruction.PING))
    slots = {name: [master_of(name, node).device.handle(everybody, 0.0)[0].slot for node in (9, 4)] for name in ("sts", "sms")}
    assert slots == {"sts": [9, 4], "sms": [0, 0]}


def test_a_broadcast_write_is_obeyed(master: Master) -> None:
    """SMS 1.0, example 3: every servo gets the id."""
    master.send(Instruction.WRITE, b"\x05\x09", to=BROADCAST_ID)
    assert master.device.node == 9


@pytest.mark.parametrize(
    ("code", "params"), [(0x02, b"\x05"), (0x03, b"\x05"), (0x04, b"\x05"), (0x0B, b""), (0x83, b"\x2a\x01\x01\x00"), (0x77, b"")]
)
def test_malformed_or_unknown_packets_get_no_reply(master: Master, code: int, params: bytes) -> None:
    """Silence, as nothing is documented."""
    assert master.send(code, params) is None


def test_response_level_0_answers_only_ping_and_read(master: Master) -> None:
    """FEETECH memory table, address 8: WRITE, REG WRITE, ACTION and RESET get no reply."""
    quiet = Master(SmsDevice(master.model, 1, baudrate=1_000_000, response_level=0))
    assert quiet.write("goal_position", 100) is None
    assert quiet.read("goal_position") == 100
    assert quiet.send(Instruction.REG_WRITE, b"\x2a\x00") is None
    assert quiet.send(Instruction.ACTION) is None
    assert quiet.send(Instruction.PING) is not None
    assert quiet.send(Instruction.RESET) is not None  # the factory's level is 1, and it is in force at once


@pytest.mark.parametrize(("raw", "delay"), [(0, 0.0), (1, 100e-6), (50, 100e-6), (250, 500e-6)])
def test_the_return_delay_has_a_minimum(raw: int, delay: float) -> None:
    """0 is none, 1 to 49 act as 50, in units of 2 us."""
    master = master_of("sts")
    master.write("return_delay", raw)
    (reply,) = master.device.handle(packet_of(encode(1, Instruction.PING)), 0.0)
    assert reply.delay == pytest.approx(delay)


def test_a_servo_without_a_return_delay_answers_at_once() -> None:
    """SCS has no such register."""
    (reply,) = master_of("scs").device.handle(packet_of(encode(1, Instruction.PING)), 0.0)
    assert (reply.delay, reply.late) == (0.0, 0.0)


def test_a_device_can_be_dead_or_late(master: Master) -> None:
    """A dead servo neither answers nor obeys; a late one has a delay."""
    master.device.dead = True
    assert master.write("goal_position", 100) is None
    master.device.dead, master.device.extra_delay = False, 0.25
    (reply,) = master.device.handle(packet_of(encode(1, Instruction.PING)), 0.0)
    assert reply.late == 0.25
    assert master.read("goal_position") == 0


# SYNC READ and SYNC WRITE


def test_sync_read_answers_in_the_order_asked() -> None:
    """The place in the request is the slot of the answer; who is not listed is silent."""
    ids = (7, 3, 5)
    frame = packet_of(encode(BROADCAST_ID, Instruction.SYNC_READ, bytes((0x38, 2, *ids))))
    replies = [master_of("sts", servo).device.handle(frame, 0.0) for servo in (3, 5, 7, 9)]
    assert [(packet_of(part[0].data).id, part[0].slot) for part in replies if part] == [(3, 1), (5, 2), (7, 0)]


def test_sync_read_ids_are_not_mixed_up_with_address_and_size() -> None:
    """A servo whose id equals the address, or the size, was not asked."""
    assert master_of("sts", 0x38).send(Instruction.SYNC_READ, b"\x38\x02\x01", to=BROADCAST_ID) is None
    assert master_of("sts", 1).send(Instruction.SYNC_READ, b"\x38", to=BROADCAST_ID) is None


@pytest.mark.parametrize("name", [name for name in FAMILIES if not model_of(name).sync_read])
def test_models_without_sync_read_ignore_it(name: str) -> None:
    """SMS 1.0 has no SYNC READ."""
    assert master_of(name).send(Instruction.SYNC_READ, b"\x38\x02\x01", to=BROADCAST_ID) is None


def test_sync_write_takes_its_own_part(master: Master) -> None:
    """SMS 1.0, example 7: each servo finds its bytes by its id, also where data looks like ids."""
    master.device.node = 2
    parts = b"\x01" + master.bytes_of("goal_position", 0x202) + b"\x02" + master.bytes_of("goal_position", 0x123)
    assert master.send(Instruction.SYNC_WRITE, b"\x2a\x02" + parts, to=BROADCAST_ID) is None
    assert master.read("goal_position") == 0x123


def test_a_torn_sync_write_changes_nothing(master: Master) -> None:
    """A packet without a whole number of parts is not obeyed."""
    master.send(Instruction.SYNC_WRITE, b"\x2a\x02\x01\x05\x05\x02", to=BROADCAST_ID)
    assert master.read("goal_position") == 0


# REG WRITE and ACTION


def test_reg_write_waits_for_action(master: Master) -> None:
    """SMS 1.0, 1.3.4: the servo keeps the write, sets its flag, and carries it out once, at ACTION."""
    data = b"\x2a" + master.bytes_of("goal_position", 600)
    assert master.send(Instruction.REG_WRITE, data) is not None
    assert (master.read("goal_position"), master.read("async_write_flag")) == (0, 1)
    master.write("goal_speed", 5)
    assert master.read("async_write_flag") == 1
    assert master.send(Instruction.ACTION, to=BROADCAST_ID) is None
    assert (master.read("goal_position"), master.read("async_write_flag")) == (600, 0)
    assert master.read(master.model.torque) == 1
    master.write("goal_position", 100)
    assert master.send(Instruction.ACTION) is not None
    assert master.read("goal_position") == 100


def test_a_second_reg_write_replaces_the_first(master: Master) -> None:
    """There is one buffer."""
    for raw in (300, 400):
        master.send(Instruction.REG_WRITE, b"\x2a" + master.bytes_of("goal_position", raw))
    master.send(Instruction.ACTION)
    assert master.read("goal_position") == 400


# A whole bus


def test_the_devices_of_a_bus_follow_its_config() -> None:
    """Id, model, rate, zero and the response level that the bus counts on."""
    options = SmsBus.model_validate(
        {
            "protocol": "sms",
            "port": "sim:",
            "baudrate": 500_000,
            "status_return": "read_only",
            "servos": {"a": {"id": 4, "model": "sts"}, "b": {"id": 5, "model": "scs", "zero": 300.4}},
        }
    )
    first, second = devices(options, packaged_models())
    assert (first.node, first.model.name, first.baudrate) == (4, "sts", 500_000)
    assert Master(first).read("present_position") == first.model.zero
    assert Master(second).read("present_position") == 300
    assert Master(second).read("response_status_level") == 0
