"""The tables and frame layouts of KST RS422, and frames computed from them."""

from __future__ import annotations

from typing import Any

import pytest

from servobus.protocols.base import Request, run_plan
from servobus.protocols.kst import DEFINITION
from servobus.protocols.kst.codec import BAUD_TABLE, FACTORY_ID, Command, decode_position, encode, encode_position, version_text
from servobus.protocols.kst.requests import Fence, Read, RequestSettings, Save, SetValue, UnansweredCommand
from tests.protocols.kst.bench import Bench, ask_device, device_of, frame_of

# Section 3.5: position, High, Low.
POSITIONS = [(-90, 0xFC, 0x7C), (-10.9, 0xFF, 0x93), (-0.8, 0xFF, 0xF8), (0, 0, 0), (0.8, 0, 8), (10.9, 0, 0x6D), (90, 3, 0x84)]
# Section 3.1.
BAUDS = [(0, 9600), (1, 19200), (2, 38400), (3, 57600), (4, 115200), (5, 256000), (6, 512000), (7, 921600)]


@pytest.mark.parametrize(("degrees", "high", "low"), POSITIONS)
def test_the_position_table(degrees: float, high: int, low: int) -> None:
    bench = Bench({"pan": {"id": FACTORY_ID}})
    raw = bench.driver.servos["pan"].to_raw(degrees)
    assert encode_position(raw) == bytes((low, high))
    assert decode_position(bytes((low, high))) == raw
    assert bench.driver.servos["pan"].to_unit(raw) == degrees


@pytest.mark.parametrize(("code", "rate"), BAUDS)
def test_the_baud_table(code: int, rate: int) -> None:
    bench = Bench({"pan": {"id": FACTORY_ID}})
    change = bench.run(bench.driver.commissioning.set_baudrate(FACTORY_ID, rate))
    assert change.value == rate == BAUD_TABLE[code]
    assert encode(FACTORY_ID, 0x06, bytes((code,))) in bench.frames()


def test_what_a_new_servo_is_set_to() -> None:
    assert (FACTORY_ID, DEFINITION.baudrates[0]) == (0x25, 512_000)
    assert sorted(DEFINITION.baudrates) == sorted(BAUD_TABLE.values())


SETTINGS = RequestSettings()
# Name of the request, its frame as sections 2 and 3 lay it out (sums computed), the reply's frame, the value.
LAYOUTS: list[tuple[Request[Any], str, str, Any]] = [
    (
        SetValue(SETTINGS, 0x25, Command.SET_BAUD, b"\6"),
        "FE CA 25 06 06 00000000000000 FB 0A",
        "FE CA 25 46 06 00000000000000 3B 0A",
        None,
    ),
    (
        SetValue(SETTINGS, 0x25, Command.SET_ID, b"\5"),
        "FE CA 25 08 05 00000000000000 FC 0A",
        "FE CA 25 48 05 00000000000000 3C 0A",
        None,
    ),
    (
        Read(SETTINGS, 0x25, Command.READ_ID, lambda data: data[0]),
        "FE CA 25 18 0000000000000000 07 0A",
        "FE CA 25 58 25 00000000000000 6C 0A",
        0x25,
    ),
    (
        SetValue(SETTINGS, 0x25, Command.SET_POSITION, b"\x7c\xfc"),
        "FE CA 25 09 7C FC 000000000000 70 0A",
        "FE CA 25 49 7C FC 000000000000 B0 0A",
        None,
    ),
    (
        Read(SETTINGS, 0x25, Command.READ_POSITION, decode_position),
        "FE CA 25 19 0000000000000000 08 0A",
        "FE CA 25 59 93 FF 000000000000 DA 0A",
        -109,
    ),
    (
        Read(SETTINGS, 0x25, Command.READ_STATUS, lambda data: data[:2]),
        "FE CA 25 10 0000000000000000 FF 0A",
        "FE CA 25 50 12 34 000000000000 85 0A",
        b"\x12\x34",
    ),
    (
        Read(SETTINGS, 0x25, Command.READ_VERSION, version_text),
        "FE CA 25 1A 0000000000000000 09 0A",
        "FE CA 25 5A 31 2E 30 30 00000000 08 0A",
        "1.00",
    ),
    (Save(SETTINGS, 0x25), "FE CA 25 0F 73 61 76 65 00000000 AD 0A", "FE CA 25 4F 0000000000000000 3E 0A", None),
    (
        Fence(SETTINGS, 0x25, Command.READ_ID, (0x25,)),
        "FE CA 25 18 0000000000000000 07 0A",
        "FE CA 25 58 25 00000000000000 6C 0A",
        None,
    ),
]


@pytest.mark.parametrize(
    ("request_", "frame", "reply", "value"), LAYOUTS, ids=lambda item: type(item).__name__ if isinstance(item, Request) else ""
)
def test_every_command_and_its_reply(request_: Request[Any], frame: str, reply: str, value: Any) -> None:
    assert request_.frame == bytes.fromhex(frame)
    decoded = frame_of(bytes.fromhex(reply))
    assert request_.answers(decoded)
    assert request_.parse([decoded]) == value
    assert (request_.replies, request_.reply_size, request_.reply_key) == (1, 14, decoded.key)


@pytest.mark.parametrize(
    ("address", "code", "data", "frame"),
    [
        (0x25, 0x19, b"", "FE CA 25 19 00 00 00 00 00 00 00 00 08 0A"),
        (0x25, 0x09, encode_position(0), "FE CA 25 09 00 00 00 00 00 00 00 00 F8 0A"),
        (0x25, 0x09, encode_position(-900), "FE CA 25 09 7C FC 00 00 00 00 00 00 70 0A"),
        (0x25, 0x09, encode_position(900), "FE CA 25 09 84 03 00 00 00 00 00 00 7F 0A"),
        (0x25, 0x0F, b"save", "FE CA 25 0F 73 61 76 65 00 00 00 00 AD 0A"),
        (0x25, 0xC9, bytes.fromhex("06090030"), "FE CA 25 C9 06 09 00 30 00 00 00 00 F7 0A"),
    ],
)
def test_the_computed_frames(address: int, code: int, data: bytes, frame: str) -> None:
    assert encode(address, code, data) == bytes.fromhex(frame)


def test_save_needs_no_reply_and_gives_the_flash_its_time() -> None:
    """KST RS422, 3.3: no reply is needed."""
    save = UnansweredCommand(SETTINGS, 0x25, Command.SAVE, b"save")
    assert save.frame == bytes.fromhex("FECA250F7361766500000000AD0A")
    assert (save.replies, save.idempotent, save.quiet_after) == (0, False, 0.2)


def test_id_and_rate_take_effect_when_saved_and_restarted() -> None:
    device = device_of()
    assert ask_device(device, Command.SET_ID, b"\5") == frame_of(encode(0x25, 0x48, b"\5"))
    assert ask_device(device, Command.SET_BAUD, b"\4") == frame_of(encode(0x25, 0x46, b"\4"))
    assert ask_device(device, Command.SAVE, b"save") is None
    assert (device.node, device.baudrate) == (0x25, 512_000)
    device.reboot(1.0)
    assert (device.node, device.baudrate) == (5, 115_200)


def test_a_position_is_taken_at_once_and_lost_by_a_restart() -> None:
    device = device_of(position=300)
    ask_device(device, Command.SET_POSITION, encode_position(600), now=0.0)
    assert device.goal == 600
    device.reboot(1.0)
    ask_device(device, Command.READ_POSITION, now=5.0)
    assert (device.goal, device.position) == (0, 0)


def test_run_plan_reads_a_servo_through_all_of_it() -> None:
    bench = Bench({"pan": {"id": FACTORY_ID}})
    assert run_plan(bench.driver.identify("pan"), bench.exchange).firmware == "1.00"
