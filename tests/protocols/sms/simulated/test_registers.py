"""The memory table of the simulated servo: what can be written, what is kept, what a restart and a reset bring back."""

from __future__ import annotations

import pytest

from servobus.protocols.model import Register
from servobus.protocols.sms.codec import Instruction
from servobus.protocols.sms.simulated.device import SmsDevice
from tests.protocols.sms.single_servo import AT_THE_GOAL, FAMILIES, Master, changed, master_of


@pytest.fixture(params=FAMILIES)
def master(request: pytest.FixtureRequest) -> Master:
    return master_of(request.param)


def test_identity_tells_firmware_order_and_model(master: Master) -> None:
    """Addresses 0 to 4 are the same in every table."""
    reply = master.send(Instruction.READ, b"\x00\x05")
    assert reply is not None
    big = master.model.byte_order == "big"
    assert reply.params[2] == big
    assert int.from_bytes(reply.params[3:], master.model.byte_order) == master.model.model_number


def test_read_only_registers_ignore_writes(master: Master) -> None:
    """Read-only registers and addresses without a register, in one block with one that can be written."""
    master.send(Instruction.WRITE, b"\x41\x07")
    assert master.read("servo_status") == 0
    master.send(Instruction.WRITE, b"\x03\x63\x63\x05")
    assert master.device.node == 5
    assert b"\x63" not in master.device.read_table(0, 5, 0.0)


def test_beyond_the_last_address_there_is_nothing(master: Master) -> None:
    """READ gets what exists, WRITE loses the rest; addresses without a register are 0."""
    assert master.send(Instruction.WRITE, b"\xfe\x01\x02\x03\x04") is not None
    replies = [master.send(Instruction.READ, params) for params in (b"\xfe\x04", b"\x80\xff", b"\x00\xff", b"\x05\x00")]
    assert [len(reply.params) for reply in replies if reply] == [2, 128, 253, 0]


def test_a_locked_eeprom_write_is_lost_at_restart(master: Master) -> None:
    """No error tells: the register shows it until then. Unlocked, it stays."""
    assert master.read("lock") == 1
    before = master.read("max_angle_limit")
    assert master.write("max_angle_limit", 700) is not None
    assert master.read("max_angle_limit") == 700
    master.device.reboot(master.now)
    master.after(10)
    assert master.read("max_angle_limit") == before
    master.write("lock", 0)
    master.write("max_angle_limit", 700)
    master.write("lock", 1)
    master.device.reboot(master.now)
    assert master.after(10).read("max_angle_limit") == 700
    assert master.read("lock") == 1


def test_a_new_id_is_in_force_at_once_and_names_the_answer(master: Master) -> None:
    """SMS 1.0, 1.3.3: without the unlock the value is lost at restart."""
    reply = master.write("id", 8)
    assert reply is not None
    assert reply.id == 8
    master.device.reboot(0.0)
    assert master.after(10).device.node == 1


def test_an_invalid_id_changes_nothing(master: Master) -> None:
    """254 is everybody, 255 the header."""
    for raw in (254, 255):
        reply = master.send(Instruction.WRITE, bytes((5, raw)))
        assert reply is not None
        assert (reply.id, master.read("id")) == (1, 1)


def test_a_new_baud_rate_is_in_force_at_once(master: Master) -> None:
    """By the vendor's codes; what is no code changes nothing."""
    master.write("lock", 0)
    master.write("baud_rate", 4)
    assert master.device.baudrate == 115_200
    master.send(Instruction.WRITE, b"\x06\x63")
    assert master.device.baudrate == 115_200
    master.device.reboot(0.0)
    assert master.device.baudrate == 115_200


def test_a_rate_without_a_code_is_the_factory_rate(master: Master) -> None:
    """A bus may be simulated at any rate."""
    other = Master(SmsDevice(master.model, 1, baudrate=460_800))
    other.device.reboot(0.0)
    assert other.device.baudrate == 460_800


def test_reset_restores_all_eeprom_but_the_id(master: Master) -> None:
    """RESET 0x06: for good, without unlocking, and answered; RAM stays."""
    other = Master(SmsDevice(master.model, 6, baudrate=500_000))
    other.write("max_angle_limit", 700)
    other.write("goal_speed", 9)
    reply = other.send(Instruction.RESET)
    assert reply is not None
    assert (reply.id, reply.params) == (6, b"")
    for _ in range(2):
        assert other.read("max_angle_limit") == master.read("max_angle_limit")
        assert other.device.node == 6
        assert other.device.baudrate != 500_000
        other.device.reboot(other.now)
        other.after(10)


def test_a_restart_is_silent_and_forgets_ram(master: Master) -> None:
    """Torque off, goal gone, REG WRITE buffer gone, torque limit from max torque, position kept."""
    master.go(600)
    master.after(AT_THE_GOAL).send(Instruction.REG_WRITE, b"\x2a" + master.bytes_of("goal_position", 100))
    master.device.reboot(master.now)
    assert master.after(master.model.reboot_s * 0.9).send(Instruction.PING) is None
    assert master.after(master.model.reboot_s).send(Instruction.PING) is not None
    names = (master.model.torque, "goal_position", "async_write_flag", "present_position")
    assert [master.read(name) for name in names] == [0, 0, 0, 600]
    master.send(Instruction.ACTION)
    assert master.read("goal_position") == 0


def test_a_restart_can_be_asked_for(master: Master) -> None:
    """Instruction 0x08 of newer documents: silence is the answer, even to the one that was asked."""
    master.go(600)
    assert master.send(0x08) is None
    assert master.after(master.model.reboot_s * 0.99).send(Instruction.PING) is None
    assert master.after(master.model.reboot_s * 0.02).read(master.model.torque) == 0


def test_the_torque_limit_comes_from_max_torque() -> None:
    """Copied when power comes on, not before."""
    master = master_of("sts")
    assert master.read("torque_limit") == 1000
    master.write("lock", 0)
    master.write("max_torque", 400)
    assert master.read("torque_limit") == 1000
    master.device.reboot(0.0)
    assert master.after(10).read("torque_limit") == 400


def test_a_users_model_may_omit_the_common_registers() -> None:
    """Id, baud rate, response level and the async flag are there all the same."""
    names = ("id", "baud_rate", "async_write_flag", "position_offset")
    model = changed("sts", **dict.fromkeys(names))
    master = Master(SmsDevice(model, 3, baudrate=1_000_000))
    assert (reply := master.send(Instruction.READ, b"\x05\x01")) is not None
    assert reply.params == b"\x03"
    master.write(model.torque, 128)
    assert master.read("present_position") == model.zero


def test_the_device_uses_registers_of_the_model() -> None:
    """The basics a model file may leave out have the addresses of the documents."""
    basics = master_of().device.memory.registers
    assert [basics[name].address for name in ("id", "baud_rate", "response_status_level", "async_write_flag")] == [5, 6, 8, 64]
    assert all(isinstance(register, Register) for register in basics.values())
