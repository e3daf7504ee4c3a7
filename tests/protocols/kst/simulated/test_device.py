"""The simulated servo follows KST RS422, 3."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from servobus.protocols.device import Device
from servobus.protocols.kst import DEFINITION
from servobus.protocols.kst.aborts import ABORTS
from servobus.protocols.kst.codec import FACTORY_ID, REQUEST_SIZES, Command, encode, encode_position
from servobus.protocols.kst.model import load_models, packaged_model
from tests.protocols.kst.bench import ask_device, bus_options, device_of, frame_of


def test_it_is_a_device_as_it_leaves_the_factory() -> None:
    device: Device = device_of()
    assert (device.node, device.baudrate) == (FACTORY_ID, 512_000)


def test_it_hears_only_its_own_address_and_commands() -> None:
    device = device_of(servo_id=5)
    for address in range(256):
        assert (ask_device(device, Command.READ_ID, to=address) is not None) is (address == 5)
    answered = [code for code in range(256) if ask_device(device, code, b"save") is not None]
    assert answered == sorted(set(REQUEST_SIZES) - {Command.SAVE})


def test_it_does_not_answer_replies() -> None:
    """Own echo on the line must not start a conversation."""
    device = device_of()
    assert all(ask_device(device, code) is None for code in range(0x40, 0x100))


@pytest.mark.parametrize("code", ABORTS)
@pytest.mark.parametrize("order", ["be", "le"])
def test_it_refuses_with_any_abort_code_on_demand(code: int, order: str) -> None:
    device = device_of()
    device.refuses = dict.fromkeys(REQUEST_SIZES, code)
    device.sdo_order = order
    for command in REQUEST_SIZES:
        reply = ask_device(device, command, b"save")
        assert reply is not None
        assert (reply.code, reply.data[:4]) == (0xC0 + command, code.to_bytes(4, "big" if order == "be" else "little"))
    assert (device.goal, device.node) == (0, FACTORY_ID)


@pytest.mark.parametrize(
    ("command", "data", "code"),
    [
        (Command.SET_BAUD, b"\x07", None),
        (Command.SET_BAUD, b"\x08", 0x06090031),
        (Command.SET_ID, b"\x01", None),
        (Command.SET_ID, b"\x00", 0x06090032),
        (Command.SET_POSITION, encode_position(900), None),
        (Command.SET_POSITION, encode_position(901), 0x06090030),
        (Command.SET_POSITION, encode_position(-900), None),
        (Command.SET_POSITION, encode_position(-901), 0x06090030),
    ],
)
def test_values_it_cannot_take_are_refused(command: Command, data: bytes, code: int | None) -> None:
    reply = ask_device(device_of(), command, data)
    assert reply is not None
    if code is None:
        assert (reply.code, reply.data[: len(data)]) == (0x40 + command, data)
    else:
        assert (reply.code, int.from_bytes(reply.data[:4], "big")) == (0xC0 + command, code)


def test_status_and_version_bytes() -> None:
    device = device_of()
    device.status_bytes = b"\x12\x34"
    assert ask_device(device, Command.READ_STATUS) == frame_of(encode(FACTORY_ID, 0x50, b"\x12\x34"))
    assert ask_device(device, Command.READ_VERSION) == frame_of(encode(FACTORY_ID, 0x5A, b"1.00"))


def test_it_moves_at_a_finite_speed_and_stays_where_it_was_sent() -> None:
    device = device_of(position=-100)
    device.speed = 1000.0
    ask_device(device, Command.SET_POSITION, encode_position(400), now=1.0)
    places = []
    for now in (1.1, 1.2, 1.1, 1.5, 9.0):
        device.advance(now)
        places.append(round(device.position))
    assert places == [0, 100, 100, 400, 400]
    ask_device(device, Command.SET_POSITION, encode_position(-400), now=9.0)
    assert ask_device(device, Command.READ_POSITION, now=9.1) == frame_of(encode(FACTORY_ID, 0x59, encode_position(300)))


def test_only_a_position_is_obeyed_as_a_broadcast_and_not_answered() -> None:
    """KST RS422, 2.1: servobus sends no broadcast; whether one is answered is not stated."""
    device = device_of(servo_id=5)
    for command in REQUEST_SIZES:
        assert ask_device(device, command, b"\x2c\x01", to=0) is None
    assert (device.goal, device.node) == (300, 5)
    device.reboot(0.0)
    assert (device.node, device.baudrate) == (5, 512_000)


def test_a_restart_loses_unsaved_settings_and_is_silent_meanwhile() -> None:
    device = device_of(position=500)
    ask_device(device, Command.SET_ID, b"\5")
    ask_device(device, Command.SET_BAUD, b"\0")
    assert ask_device(device, Command.SAVE, b"sabe") is None
    device.reboot(1.0)
    assert ask_device(device, Command.READ_ID, now=1.0 + packaged_model().reboot_s - 1e-6) is None
    assert ask_device(device, Command.READ_ID, now=1.0 + packaged_model().reboot_s) is not None
    assert (device.node, device.baudrate, device.goal) == (FACTORY_ID, 512_000, 0)


def test_settings_can_count_at_once() -> None:
    """KST RS422, 3.1, 3.2: a change is in effect after save and restart."""
    device = device_of(immediate=True)
    assert ask_device(device, Command.SET_ID, b"\5") == frame_of(encode(FACTORY_ID, 0x48, b"\5"))
    assert device.node == 5
    assert ask_device(device, Command.SET_BAUD, b"\0") == frame_of(encode(5, 0x46, b"\0"))
    assert device.baudrate == 9600


def test_a_save_that_is_answered() -> None:
    """KST RS422, 3.3: a save needs no reply."""
    device = device_of()
    device.answers_save = True
    assert ask_device(device, Command.SAVE, b"save") == frame_of(encode(FACTORY_ID, 0x4F))


def test_dead_and_late() -> None:
    device = device_of()
    device.extra_delay = 0.5
    (reply,) = device.handle(frame_of(encode(FACTORY_ID, Command.READ_ID)), 0.0)
    assert (reply.delay, reply.late) == (device.delay, 0.5)
    device.dead = True
    assert ask_device(device, Command.READ_ID) is None


def test_simulated_servos_begin_at_zero_and_follow_the_options() -> None:
    options = bus_options(
        {"pan": {"id": 1, "zero": 120}},
        baudrate=9600,
        version_byte=0xCB,
        sdo_order="le",
        save_reply="required",
        id_effective="immediate",
    )
    (device,) = DEFINITION.devices(options, load_models(options, Path()))
    assert (device.node, device.baudrate) == (1, 9600)
    kst = device_of()
    assert isinstance(device, type(kst))
    assert (device.position, device.version, device.sdo_order, device.answers_save) == (120, 0xCB, "le", True)
    assert device.immediate
    defaults = bus_options()
    for servo in DEFINITION.devices(defaults, load_models(defaults, Path())):
        assert isinstance(servo, type(kst))
        assert (servo.position, servo.sdo_order, servo.answers_save, servo.immediate) == (0, "be", False, False)


def test_the_definition_has_every_part() -> None:
    assert DEFINITION.scan_ids == range(1, 255)
    frame = encode(5, 0x58, b"\5")
    assert DEFINITION.node_of(frame) == 5
    assert DEFINITION.node_of(DEFINITION.rename(frame, random.Random(1))) != 5
    for made in (DEFINITION.codec(None), DEFINITION.device_codec(None)):
        made.receive_data(frame)
        assert made.next_reply() == frame_of(frame)
    assert DEFINITION.driver(bus_options({}), {}).nodes == {}
