"""Frames are decoded from a stream, at both ends of the line, whatever surrounds them and however they are cut."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobus.protocols.modbus.codec import (
    MAX_READ,
    MAX_UNIT,
    MAX_WRITE,
    TABLE,
    Frame,
    Function,
    ModbusCodec,
    crc16,
    describe,
    encode,
    node_of,
    pack,
    rename,
    reply_key,
    unpack,
)

READ = encode(2, Function.READ_HOLDING, pack((1135, 6)))
REPLY = encode(2, Function.READ_HOLDING, bytes((12,)) + pack((1, 2, 3, 4, 5, 65535)))
WRITE = encode(2, Function.WRITE_MULTIPLE, pack((1135, 2)) + b"\x04" + pack((7, 8)))
WROTE = encode(2, Function.WRITE_MULTIPLE, pack((1135, 2)))
SINGLE = encode(2, Function.WRITE_SINGLE, pack((1010, 500)))
NO = encode(2, 0x90, b"\4")
RECEIVED = (REPLY, WROTE, SINGLE, NO)
ASKED = (READ, WRITE, SINGLE)


def frames_in(codec: ModbusCodec, *pieces: bytes) -> list[bytes]:
    frames = []
    for piece in pieces:
        codec.receive_data(piece)
        while (frame := codec.next_reply()) is not None:
            frames.append(frame.frame)
    return frames


def chopped(data: bytes, how: str, seed: int = 1) -> list[bytes]:
    if how == "whole":
        return [data]
    if how == "bytes":
        return [bytes((byte,)) for byte in data]
    rng, pieces = random.Random(seed), []
    while data:
        size = rng.randint(1, 9)
        pieces.append(data[:size])
        data = data[size:]
    return pieces


DELIVERIES = pytest.mark.parametrize("how", ["whole", "bytes", "random"])


# CRC


def crc_bit_by_bit(data: bytes) -> int:
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ 0xA001 if crc & 1 else crc >> 1
    return crc


@pytest.mark.parametrize(("data", "crc"), [(b"", 0xFFFF), (b"123456789", 0x4B37), (b"\0", 0x40BF), (b"\2\7", 0x1241)])
def test_crc_vectors(data: bytes, crc: int) -> None:
    assert crc16(data) == crc


@given(st.binary(max_size=64))
def test_the_table_is_the_polynomial(data: bytes) -> None:
    assert crc16(data) == crc_bit_by_bit(data)
    assert crc16(data + crc16(data).to_bytes(2, "little")) == 0
    assert len(set(TABLE)) == 256


# Encoding


@pytest.mark.parametrize("unit", [-1, MAX_UNIT + 1, 256])
def test_a_unit_that_cannot_be_addressed_is_refused(unit: int) -> None:
    with pytest.raises(ValueError, match="outside 1 to 247"):
        encode(unit, 3, b"")


@pytest.mark.parametrize("unit", [0, 1, MAX_UNIT])
def test_units_at_the_edge(unit: int) -> None:
    assert node_of(encode(unit, 6, pack((1, 2)))) == unit


@given(st.lists(st.integers(0, 65535), max_size=20))
def test_registers_round_trip(values: list[int]) -> None:
    assert unpack(pack(values)) == values


# Both ends


@DELIVERIES
def test_a_master_finds_answers_however_they_are_delivered(how: str) -> None:
    assert frames_in(ModbusCodec(), *chopped(b"".join(RECEIVED), how)) == list(RECEIVED)


@DELIVERIES
def test_a_device_finds_questions_however_they_are_delivered(how: str) -> None:
    assert frames_in(ModbusCodec("device"), *chopped(b"".join(ASKED), how)) == list(ASKED)


@DELIVERIES
@pytest.mark.parametrize("echoed", ASKED)
def test_a_master_finds_its_own_echo_before_the_answer(echoed: bytes, how: str) -> None:
    codec = ModbusCodec()
    assert frames_in(codec, *chopped(echoed + REPLY, how)) == [echoed, REPLY]
    assert codec.skipped == 0


@DELIVERIES
@pytest.mark.parametrize("end", ["master", "device"])
@pytest.mark.parametrize("junk", [b"\0", b"\0" * 9, b"\xff" * 20, b"\2\x44", b"\xf8\3", b"\2\x83\4\0\0", b"\7\x41\xff"])
def test_what_is_no_frame_is_skipped_and_counted(junk: bytes, end: str, how: str) -> None:
    codec, frame = (ModbusCodec(), WROTE) if end == "master" else (ModbusCodec("device"), SINGLE)
    assert frames_in(codec, *chopped(junk + frame + junk + frame, how)) == [frame, frame]
    assert (codec.skipped, codec.pending) == (2 * len(junk), 0)


@DELIVERIES
@pytest.mark.parametrize("end", ["master", "device"])
def test_a_half_frame_swallows_no_more_than_the_longest_frame(end: str, how: str) -> None:
    """A frame that begins may be as long as its byte count; the next request resets the codec."""
    frames = RECEIVED if end == "master" else ASKED
    for frame in frames:
        for cut in range(len(frame)):
            codec = ModbusCodec() if end == "master" else ModbusCodec("device")
            after = [frames[0]] * 35
            assert frames_in(codec, *chopped(frame[:cut] + b"".join(after), how))[-2:] == after[-2:]


@pytest.mark.parametrize("frame", RECEIVED)
def test_every_byte_of_a_frame_counts(frame: bytes) -> None:
    for at in range(len(frame)):
        for change in (0x01, 0x80, 0xFF):
            broken = frame[:at] + bytes((frame[at] ^ change,)) + frame[at + 1 :]
            assert frame not in frames_in(ModbusCodec(), broken, b"\xff" * 300)
            assert broken not in frames_in(ModbusCodec(), broken, b"\xff" * 300)


@given(st.binary(max_size=400), st.sampled_from(["master", "device"]))
def test_noise_is_survived_and_nothing_is_kept_that_no_frame_needs(data: bytes, end: str) -> None:
    codec = ModbusCodec() if end == "master" else ModbusCodec("device")
    frames = frames_in(codec, data)
    assert sum(map(len, frames)) + codec.skipped + codec.pending == len(data)
    assert all(crc16(frame) == 0 for frame in frames)
    assert codec.pending < 273
    codec.reset()
    assert codec.pending == 0


@given(st.binary(max_size=60), st.integers(1, 40))
def test_where_it_is_cut_makes_no_difference(noise: bytes, seed: int) -> None:
    data = noise + REPLY + noise + NO
    assert frames_in(ModbusCodec(), *chopped(data, "random", seed)) == frames_in(ModbusCodec(), data)


def test_the_time_for_each_byte_is_bounded() -> None:
    """A stream in which each byte may begin the longest frame: one CRC for each, and no more is kept than that frame."""
    codec = ModbusCodec()
    for _ in range(20):
        codec.receive_data(b"\3" * 251)
        assert codec.next_reply() is None
        assert codec.pending < 256


# Counts that cannot be


@pytest.mark.parametrize("count", [0, 1, 5, 251, 255])
def test_an_answer_of_no_whole_registers_is_none(count: int) -> None:
    data = encode(2, 3, bytes((count,)) + bytes(count))
    codec = ModbusCodec()
    assert data not in frames_in(codec, data)


@pytest.mark.parametrize("registers", [1, MAX_READ])
def test_answers_at_the_edge(registers: int) -> None:
    data = encode(2, 3, bytes((2 * registers,)) + bytes(2 * registers))
    assert frames_in(ModbusCodec(), data) == [data]


@pytest.mark.parametrize("registers", [1, MAX_WRITE])
def test_writes_at_the_edge(registers: int) -> None:
    data = encode(2, 16, pack((1, registers)) + bytes((2 * registers,)) + bytes(2 * registers))
    assert frames_in(ModbusCodec("device"), data) == [data]


@pytest.mark.parametrize(("registers", "size"), [(0, 0), (MAX_WRITE + 1, 248), (2, 2), (1, 3)])
def test_a_write_whose_number_and_bytes_differ_is_none(registers: int, size: int) -> None:
    data = encode(2, 16, pack((1, registers)) + bytes((size,)) + bytes(size))
    assert data not in frames_in(ModbusCodec("device"), data)


@pytest.mark.parametrize(
    "content",
    [
        (1, pack((0, 1))),
        (5, pack((0, 1))),
        (7, b""),
        (15, pack((0, 8)) + b"\1\xff"),
        (22, bytes(6)),
        (23, bytes(8) + b"\2\0\1"),
        (24, bytes(2)),
    ],
)
def test_a_device_reads_the_other_functions_too(content: tuple[int, bytes]) -> None:
    data = encode(2, *content)
    assert frames_in(ModbusCodec("device"), *chopped(data + READ, "bytes")) == [data, READ]


# What frames say


def test_a_frame_has_its_node_and_its_key() -> None:
    codec = ModbusCodec()
    codec.receive_data(REPLY + WROTE + SINGLE + NO)
    reply, wrote, single, refused = (codec.next_reply() for _ in range(4))
    assert isinstance(reply, Frame)
    assert (reply.node, reply.status) == (2, None)
    assert reply.key == reply_key(3, b"\x0c")
    assert wrote is not None
    assert wrote.key == reply_key(16, pack((1135, 2)))
    assert single is not None
    assert single.key == reply_key(6, pack((1010, 500)))
    assert refused is not None
    assert refused.key == reply_key(0x90, b"\4")


@given(st.sampled_from(RECEIVED), st.integers())
def test_renamed_it_is_another_units_and_right(frame: bytes, seed: int) -> None:
    other = rename(frame, random.Random(seed))
    assert node_of(other) != node_of(frame)
    assert 1 <= node_of(other) <= MAX_UNIT
    assert frames_in(ModbusCodec(), other) == [other]


@pytest.mark.parametrize(
    ("frame", "sent", "text"),
    [
        (READ, True, "unit 2 READ 1135 to 1140"),
        (encode(2, 3, pack((1000, 1))), True, "unit 2 READ 1000"),
        (REPLY, False, "unit 2 READ 1 2 3 4 5 65535"),
        (encode(2, 3, pack((1000, 2))), False, "unit 2 READ 1000 to 1001"),
        (WRITE, True, "unit 2 WRITE 1135 to 1136 = 7 8"),
        (WROTE, False, "unit 2 WRITE 1135 to 1136"),
        (SINGLE, True, "unit 2 WRITE ONE 1010 = 500"),
        (encode(0, 6, pack((1010, 500))), True, "all WRITE ONE 1010 = 500"),
        (NO, False, "unit 2 WRITE refused: exception 4"),
        (encode(2, 7, b""), True, "unit 2 function 0x07"),
        (encode(2, 1, pack((0, 8))), True, "unit 2 function 0x01 00 00 00 08"),
        (REPLY[:-1], False, f"not a Modbus-RTU frame: {REPLY[:-1].hex(' ')}"),
        (WROTE + b"\0", False, f"not a Modbus-RTU frame: {(WROTE + bytes(1)).hex(' ')}"),
    ],
)
def test_frames_are_described(frame: bytes, sent: bool, text: str) -> None:
    assert describe(frame, sent=sent) == text
    assert ModbusCodec().describe(frame, sent=sent) == text
