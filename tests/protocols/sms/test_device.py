"""The simulated FEETECH servo against the documents: every instruction, every register that lives (feetech.md, 2 to 9)."""

from __future__ import annotations

import pytest

from servobus.protocols.model import Register
from servobus.protocols.sms.codec import BROADCAST_ID, Instruction, Packet, SmsCodec, encode
from servobus.protocols.sms.device import SmsDevice, devices
from servobus.protocols.sms.load import packaged_models
from servobus.protocols.sms.model import SmsModel
from servobus.protocols.sms.options import SmsBus

FAMILIES = ("sms", "sms_cl", "sts", "scs")
AT_THE_GOAL = 100.0
"""Seconds after which every motion is over."""


def packet_of(frame: bytes) -> Packet:
    codec = SmsCodec()
    codec.receive_data(frame)
    packet = codec.next_reply()
    assert packet is not None
    return packet


class Master:
    """Speaks to one device, and owns the time."""

    def __init__(self, device: SmsDevice) -> None:
        self.device = device
        self.model = device.model
        self.now = 0.0

    def say(self, code: int, params: bytes = b"", *, to: int | None = None) -> Packet | None:
        """What comes back, if anything does."""
        frame = encode(self.device.node if to is None else to, code, params)
        replies = self.device.handle(packet_of(frame), self.now)
        assert len(replies) <= 1
        return packet_of(replies[0].data) if replies else None

    def bytes_of(self, name: str, raw: int) -> bytes:
        return self.model.registers[name].encode(raw, self.model.byte_order)

    def write(self, name: str, raw: int) -> Packet | None:
        return self.say(Instruction.WRITE, bytes((self.model.registers[name].address,)) + self.bytes_of(name, raw))

    def read(self, name: str) -> int:
        register = self.model.registers[name]
        reply = self.say(Instruction.READ, bytes((register.address, register.size)))
        assert reply is not None
        return register.decode(reply.params, self.model.byte_order)

    def go(self, position: int, *, time: int = 0, speed: int = 0) -> None:
        words = zip(self.model.goal, (position, time, speed), strict=True)
        data = b"".join(self.bytes_of(name, raw) for name, raw in words)
        assert self.say(Instruction.WRITE, bytes((self.model.registers[self.model.goal[0]].address,)) + data) is not None

    def after(self, seconds: float) -> Master:
        self.now += seconds
        return self


def model_of(name: str) -> SmsModel:
    return packaged_models()[name]


def master_of(name: str = "sts", servo_id: int = 1, **options: int) -> Master:
    settings = {"baudrate": 1_000_000, **options}
    return Master(SmsDevice(model_of(name), servo_id, **settings))


def changed(name: str, **registers: dict[str, object] | None) -> SmsModel:
    """A model with some registers changed, added, or (None) taken out."""
    data = model_of(name).model_dump()
    for register, entry in registers.items():
        if entry is None:
            del data["registers"][register]
        else:
            data["registers"][register] = {**data["registers"].get(register, {}), **entry}
    return SmsModel.model_validate(data)


@pytest.fixture(params=FAMILIES)
def master(request: pytest.FixtureRequest) -> Master:
    return master_of(request.param)


# Who answers what


def test_ping_is_answered_with_the_health_byte(master: Master) -> None:
    """PING of the seed, example 1, and a health byte of five bits."""
    assert (reply := master.say(Instruction.PING)) is not None
    assert reply.frame.hex(" ").upper() == "FF FF 01 02 00 FC"
    master.device.faults = 0x25
    assert (reply := master.say(Instruction.PING)) is not None
    assert (reply.id, reply.code, reply.params) == (1, 0x25, b"")


def test_the_health_byte_is_in_every_reply_and_in_register_65(master: Master) -> None:
    """A fault is told whatever is asked."""
    master.device.faults = 4
    assert master.read("servo_status") == 4
    reply = master.say(Instruction.READ, b"\x05\x01")
    assert reply is not None
    assert (reply.code, reply.params) == (4, b"\x01")


def test_seed_example_2_reads_1304() -> None:
    """The bytes of the seed's READ example come from a servo at 1304."""
    reply = master_of("sms", position=1304).say(Instruction.READ, b"\x38\x02")
    assert reply is not None
    assert reply.frame.hex(" ").upper() == "FF FF 01 04 00 18 05 DD"


def test_other_ids_are_none_of_its_business(master: Master) -> None:
    """Only its own id and the broadcast id count."""
    assert master.say(Instruction.PING, to=2) is None


@pytest.mark.parametrize("code", [c for c in Instruction if c not in (Instruction.PING, Instruction.SYNC_READ)])
def test_a_broadcast_is_not_answered(master: Master, code: int) -> None:
    """Seed 1.1: none but PING."""
    assert master.say(code, b"\x05\x01", to=BROADCAST_ID) is None
    assert master.say(Instruction.PING, to=BROADCAST_ID) is not None


def test_a_broadcast_write_is_obeyed(master: Master) -> None:
    """Seed, example 3: every servo gets the id."""
    master.say(Instruction.WRITE, b"\x05\x09", to=BROADCAST_ID)
    assert master.device.node == 9


@pytest.mark.parametrize(
    ("code", "params"), [(0x02, b"\x05"), (0x03, b"\x05"), (0x04, b"\x05"), (0x08, b""), (0x83, b"\x2a\x01\x01\x00"), (0x77, b"")]
)
def test_what_is_malformed_or_unknown_is_not_answered(master: Master, code: int, params: bytes) -> None:
    """Silence, as nothing is documented."""
    assert master.say(code, params) is None


def test_response_level_0_answers_only_questions(master: Master) -> None:
    """Feetech.md, section 4: WRITE, REG WRITE, ACTION and RESET are obeyed in silence."""
    quiet = Master(SmsDevice(master.model, 1, baudrate=1_000_000, response_level=0))
    assert quiet.write("goal_position", 100) is None
    assert quiet.read("goal_position") == 100
    assert quiet.say(Instruction.REG_WRITE, b"\x2a\x00") is None
    assert quiet.say(Instruction.ACTION) is None
    assert quiet.say(Instruction.PING) is not None
    assert quiet.say(Instruction.RESET) is not None  # the factory's level is 1, and it is in force at once


@pytest.mark.parametrize(("raw", "delay"), [(0, 0.0), (1, 100e-6), (50, 100e-6), (250, 500e-6)])
def test_the_return_delay_has_a_least_value(raw: int, delay: float) -> None:
    """0 is none, 1 to 49 act as 50, in units of 2 us."""
    master = master_of("sts")
    master.write("return_delay", raw)
    (reply,) = master.device.handle(packet_of(encode(1, Instruction.PING)), 0.0)
    assert reply.delay == pytest.approx(delay)


def test_a_servo_without_a_return_delay_answers_at_once() -> None:
    """SCS has no such register."""
    (reply,) = master_of("scs").device.handle(packet_of(encode(1, Instruction.PING)), 0.0)
    assert (reply.delay, reply.late) == (0.0, 0.0)


def test_hooks_make_it_dead_or_late(master: Master) -> None:
    """A dead servo neither answers nor obeys; a late one says by how much."""
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
    assert master_of("sts", 0x38).say(Instruction.SYNC_READ, b"\x38\x02\x01", to=BROADCAST_ID) is None
    assert master_of("sts", 1).say(Instruction.SYNC_READ, b"\x38", to=BROADCAST_ID) is None


@pytest.mark.parametrize("name", ["sms", "sms_cl", "scs"])
def test_sync_read_is_unknown_to_models_without_it(name: str) -> None:
    """The seed has no SYNC READ."""
    if not model_of(name).sync_read:
        assert master_of(name).say(Instruction.SYNC_READ, b"\x38\x02\x01", to=BROADCAST_ID) is None


def test_sync_write_takes_its_own_part(master: Master) -> None:
    """Seed, example 7: each servo finds its bytes by its id, also where data looks like ids."""
    master.device.node = 2
    parts = b"\x01" + master.bytes_of("goal_position", 0x202) + b"\x02" + master.bytes_of("goal_position", 0x123)
    assert master.say(Instruction.SYNC_WRITE, b"\x2a\x02" + parts, to=BROADCAST_ID) is None
    assert master.read("goal_position") == 0x123


def test_a_torn_sync_write_changes_nothing(master: Master) -> None:
    """A packet without a whole number of parts is not obeyed."""
    master.say(Instruction.SYNC_WRITE, b"\x2a\x02\x01\x05\x05\x02", to=BROADCAST_ID)
    assert master.read("goal_position") == 0


# REG WRITE and ACTION


def test_reg_write_waits_for_action(master: Master) -> None:
    """Seed 1.3.4: kept, told by the flag, done at ACTION, once."""
    data = b"\x2a" + master.bytes_of("goal_position", 600)
    assert master.say(Instruction.REG_WRITE, data) is not None
    assert (master.read("goal_position"), master.read("async_write_flag")) == (0, 1)
    master.write("goal_speed", 5)
    assert master.read("async_write_flag") == 1
    assert master.say(Instruction.ACTION, to=BROADCAST_ID) is None
    assert (master.read("goal_position"), master.read("async_write_flag")) == (600, 0)
    assert master.read(master.model.torque) == 1
    master.write("goal_position", 100)
    assert master.say(Instruction.ACTION) is not None
    assert master.read("goal_position") == 100


def test_a_second_reg_write_replaces_the_first(master: Master) -> None:
    """There is one buffer."""
    for raw in (300, 400):
        master.say(Instruction.REG_WRITE, b"\x2a" + master.bytes_of("goal_position", raw))
    master.say(Instruction.ACTION)
    assert master.read("goal_position") == 400


# The memory table


def test_identity_tells_firmware_order_and_model(master: Master) -> None:
    """Addresses 0 to 4 are the same in every table."""
    reply = master.say(Instruction.READ, b"\x00\x05")
    assert reply is not None
    big = master.model.byte_order == "big"
    assert reply.params[2] == big
    assert int.from_bytes(reply.params[3:], master.model.byte_order) == master.model.model_number


def test_what_can_only_be_read_ignores_writes(master: Master) -> None:
    """Read-only registers and addresses without a register, in one block with one that can be written."""
    master.say(Instruction.WRITE, b"\x41\x07")
    assert master.read("servo_status") == 0
    master.say(Instruction.WRITE, b"\x03\x63\x63\x05")
    assert master.device.node == 5
    assert b"\x63" not in master.device.look(0, 5, 0.0)


def test_beyond_the_last_address_there_is_nothing(master: Master) -> None:
    """READ gets what exists, WRITE loses the rest; addresses without a register are 0."""
    assert master.say(Instruction.WRITE, b"\xfe\x01\x02\x03\x04") is not None
    replies = [master.say(Instruction.READ, params) for params in (b"\xfe\x04", b"\x80\xff", b"\x00\xff", b"\x05\x00")]
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
    """Feetech.md, section 9; without unlocking it is lost at restart."""
    reply = master.write("id", 8)
    assert reply is not None
    assert reply.id == 8
    master.device.reboot(0.0)
    assert master.after(10).device.node == 1


def test_what_is_no_id_changes_nothing(master: Master) -> None:
    """254 is everybody, 255 the header."""
    for raw in (254, 255):
        reply = master.say(Instruction.WRITE, bytes((5, raw)))
        assert reply is not None
        assert (reply.id, master.read("id")) == (1, 1)


def test_a_new_baud_rate_is_in_force_at_once(master: Master) -> None:
    """By the vendor's codes; what is no code changes nothing."""
    master.write("lock", 0)
    master.write("baud_rate", 4)
    assert master.device.baudrate == 115_200
    master.say(Instruction.WRITE, b"\x06\x63")
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
    reply = other.say(Instruction.RESET)
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
    master.after(AT_THE_GOAL).say(Instruction.REG_WRITE, b"\x2a" + master.bytes_of("goal_position", 100))
    master.device.reboot(master.now)
    assert master.after(master.model.reboot_s * 0.9).say(Instruction.PING) is None
    assert master.after(master.model.reboot_s).say(Instruction.PING) is not None
    names = (master.model.torque, "goal_position", "async_write_flag", "present_position")
    assert [master.read(name) for name in names] == [0, 0, 0, 600]
    master.say(Instruction.ACTION)
    assert master.read("goal_position") == 0


def test_the_torque_limit_comes_from_max_torque() -> None:
    """Copied when power comes on, not before."""
    master = master_of("sts")
    assert master.read("torque_limit") == 1000
    master.write("lock", 0)
    master.write("max_torque", 400)
    assert master.read("torque_limit") == 1000
    master.device.reboot(0.0)
    assert master.after(10).read("torque_limit") == 400


def test_own_models_may_leave_out_what_every_table_has() -> None:
    """Id, baud rate, response level and the async flag are there all the same."""
    names = ("id", "baud_rate", "async_write_flag", "position_offset", "present_current")
    model = changed("sts", **dict.fromkeys(names))
    master = Master(SmsDevice(model, 3, baudrate=1_000_000))
    assert (reply := master.say(Instruction.READ, b"\x05\x01")) is not None
    assert reply.params == b"\x03"
    master.write(model.torque, 128)
    assert master.read("present_position") == model.zero


# Motion


def test_a_goal_switches_torque_on_and_is_reached_in_time(master: Master) -> None:
    """From the middle at 100 steps/s: half way after half the time, then still at the goal."""
    middle = master.model.zero
    scale = master.model.registers["goal_speed"].scale
    speed = round(100 / scale)
    master.go(middle + 100, speed=speed)
    assert master.read(master.model.torque) == 1
    rate = speed * scale
    master.after(50 / rate)
    names = ("present_position", "present_speed", "moving")
    assert [master.read(name) for name in names] == [middle + 50, speed, 1]
    master.after(50 / rate)
    assert [master.read(name) for name in names] == [middle + 100, 0, 0]
    assert master.after(10).read("present_position") == middle + 100


def test_motion_goes_both_ways(master: Master) -> None:
    """Down as well as up."""
    middle = master.model.zero
    master.go(middle - 100)
    assert master.after(AT_THE_GOAL).read("present_position") == middle - 100


def test_speed_0_is_the_greatest_speed() -> None:
    """And no speed is greater."""
    for speed in (0, 30_000):
        master = master_of("sts", position=1000)
        master.go(3000, speed=speed)
        master.after(1000 / master.model.max_steps_per_second)
        assert master.read("present_position") == 2000


def test_the_time_word_rules_where_it_is_milliseconds() -> None:
    """SCS: used when the speed is 0; STS does not look at it."""
    master = master_of("scs", position=500)
    master.go(600, time=2000)
    assert master.after(1).read("present_position") == 550
    master.go(550, time=1000)  # already there: no way, no speed
    assert master.read("moving") == 0
    other = master_of("sts", position=500)
    other.go(600, time=2000)
    assert other.after(1).read("present_position") == 600


def test_limits_stop_the_joint_and_leave_the_goal_register(master: Master) -> None:
    """Feetech.md, section 9: clamped without a word."""
    master.write("min_angle_limit", 300)
    master.write("max_angle_limit", 700)
    for goal, end in ((900, 700), (100, 300)):
        master.go(goal)
        master.after(AT_THE_GOAL)
        assert (master.read("goal_position"), master.read("present_position")) == (goal, end)


def test_torque_off_stops_where_it_is(master: Master) -> None:
    """And torque on goes on to the goal of the register."""
    middle = master.model.zero
    speed = round(100 / master.model.registers["goal_speed"].scale)
    master.go(middle + 200, speed=speed)
    master.after(1).write(master.model.torque, 0)
    stood = master.read("present_position")
    assert middle < stood < middle + 200
    assert master.after(10).read("present_position") == stood
    master.write(master.model.torque, 1)
    assert master.after(10).read("present_position") == middle + 200


def test_no_torque_limit_no_motion() -> None:
    """A torque limit of 0 holds nothing and moves nothing."""
    master = master_of("sts", position=1000)
    master.write("torque_limit", 0)
    master.go(2000)
    assert master.after(10).read("present_position") == 1000


def test_a_wheel_runs_at_signed_speed() -> None:
    """Mode 1: past a whole turn, backwards too, and 0 is rest."""
    master = master_of("sts", position=4000)
    scale = master.model.registers["goal_speed"].scale
    master.write("mode", 1)
    master.write("goal_speed", round(200 / scale))
    assert master.after(1).read("present_position") == 4000  # torque is off
    master.write(master.model.torque, 1)
    assert master.after(1).read("present_position") == 104
    master.write("goal_speed", -round(200 / scale))
    assert master.after(1).read("present_position") == 4000
    assert master.read("present_speed") == -round(200 / scale)
    master.write("goal_speed", 0)
    assert (master.read("moving"), master.after(9).read("present_position")) == (0, 4000)


def test_scs_is_a_wheel_when_both_limits_are_0() -> None:
    """The mode of a model is what its file says."""
    master = master_of("scs", position=500)
    master.write("min_angle_limit", 0)
    master.write("max_angle_limit", 0)
    master.write("goal_speed", 50)
    master.write(master.model.torque, 1)
    assert master.after(1).read("present_position") == 500 + round(50 * master.model.registers["goal_speed"].scale)


def test_without_limits_turns_are_counted() -> None:
    """Both limits 0 on STS: beyond one turn and below none; a restart forgets the turns."""
    master = master_of("sts", position=1000)
    master.write("min_angle_limit", 0)
    master.write("max_angle_limit", 0)
    master.go(9000)
    assert master.after(AT_THE_GOAL).read("present_position") == 9000
    master.go(-100)
    assert master.after(AT_THE_GOAL).read("present_position") == -100
    master.device.reboot(master.now)
    assert master.after(10).read("present_position") == 3996


def test_other_modes_rest() -> None:
    """PWM and step mode are not simulated."""
    master = master_of("sts", position=1000)
    master.write("mode", 3)
    master.go(2000)
    assert master.after(10).read("present_position") == 1000


def test_the_offset_shifts_what_is_reported() -> None:
    """present = (raw - offset) mod steps per turn."""
    master = master_of("sts", position=100)
    master.write("position_offset", 200)
    assert master.read("present_position") == 3996
    master.write("position_offset", -50)
    assert master.read("present_position") == 150
    master.device.reboot(0.0)
    assert master.after(10).read("present_position") == 100


@pytest.mark.parametrize("position", [0, 1, 100, 2048, 4095])
def test_torque_128_makes_this_the_middle(position: int) -> None:
    """It is kept though the lock is on; torque stays what it was. Exactly half a turn off no offset can hold."""
    master = master_of("sts", position=position)
    master.say(Instruction.WRITE, b"\x28\x80")
    assert master.read(master.model.torque) == 0
    master.device.reboot(0.0)
    assert master.after(10).read("present_position") == (2047 if position == 0 else 2048)


def test_load_follows_speed_and_ends_at_the_torque_limit() -> None:
    """Full load where something holds the joint, none where it rests."""
    master = master_of("sts", position=1000)
    fastest = master.model.max_steps_per_second
    master.go(3000, speed=round(fastest / 2 / master.model.registers["goal_speed"].scale))
    assert master.after(0.1).read("present_load") == 500
    assert master.read("present_current") > 0
    master.device.joint.stuck = True
    stood = master.read("present_position")
    assert master.after(1).read("present_load") == 1000
    assert (master.read("present_position"), master.read("moving"), master.read("present_goal_position")) == (stood, 0, 3000)
    master.write("torque_limit", 300)
    assert master.read("present_load") == 300
    master.go(0)
    assert master.read("present_load") == -300
    master.write(master.model.torque, 0)
    assert (master.read("present_load"), master.read("present_current")) == (0, 0)


def test_it_warms_up_and_cools_down(master: Master) -> None:
    """Slowly, and only under load; the voltage is what it is."""
    cold = master.read("present_temperature")
    master.go(700)
    master.device.joint.stuck = True
    assert cold < master.after(60).read("present_temperature") < 70
    master.device.joint.stuck = False
    assert master.after(2000).read("present_temperature") == cold
    assert master.read("present_voltage") == round(master.device.voltage / master.model.registers["present_voltage"].scale)


def test_time_that_passed_already_changes_nothing(master: Master) -> None:
    """A question about the past is answered with the present."""
    master.go(700)
    master.after(AT_THE_GOAL).read("present_position")
    assert master.after(-50).read("present_position") == 700


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


def test_registers_of_the_device_are_registers() -> None:
    """The basics a model file may leave out have the addresses of the documents."""
    basics = master_of().device.memory.registers
    assert [basics[name].address for name in ("id", "baud_rate", "response_status_level", "async_write_flag")] == [5, 6, 8, 64]
    assert all(isinstance(register, Register) for register in basics.values())
