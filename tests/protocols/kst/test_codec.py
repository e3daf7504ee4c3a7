"""Frames are decoded from a stream, whatever bytes surround them and however they are cut."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobus.protocols.kst.codec import (
    DATA_SIZE,
    DATA_SIZES,
    SIZE,
    Command,
    Frame,
    KstCodec,
    decode_position,
    describe,
    encode,
    encode_position,
    name_of,
    node_of,
    rename,
    version_text,
)
from tests.protocols.kst.bench import frame_of, steady

READ = encode(0x25, Command.READ_POSITION)
REPLY = encode(0x25, 0x59, encode_position(-109))


def frames_in(*pieces: bytes, codec: KstCodec | None = None) -> list[bytes]:
    codec = codec or KstCodec()
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
        size = rng.randint(1, 20)
        pieces.append(data[:size])
        data = data[size:]
    return pieces


DELIVERIES = pytest.mark.parametrize("how", ["whole", "bytes", "random"])


@DELIVERIES
def test_frames_are_decoded_however_they_are_delivered(how: str) -> None:
    assert frames_in(*chopped(READ + REPLY + READ, how)) == [READ, REPLY, READ]


@DELIVERIES
@pytest.mark.parametrize(
    "junk",
    [
        b"\0\0\0",
        b"\xfe",
        b"\xfe\xfe\xfe",
        b"\xca",
        b"\xfe\xca",
        b"\xff" * 20,
        READ[:13],
        READ[1:],
        b"\xfe\xca" * 9,
        REPLY[:-1] + b"\x0b",
    ],
)
def test_what_is_no_frame_is_skipped_and_counted(junk: bytes, how: str) -> None:
    codec = KstCodec()
    assert frames_in(*chopped(junk + REPLY + junk + READ, how), codec=codec) == [REPLY, READ]
    assert codec.skipped == 2 * len(junk)
    assert codec.pending == 0


@DELIVERIES
def test_a_half_frame_does_not_swallow_the_next_one(how: str) -> None:
    """Whether a servo gives up half a frame is not stated; this end always finds the next one."""
    for cut in range(SIZE):
        assert frames_in(*chopped(REPLY[:cut] + READ, how)) == [READ]


@DELIVERIES
def test_header_and_trailer_inside_the_data_do_not_mislead(how: str) -> None:
    """KST RS422, 2: header and trailer may occur in the data."""
    inside = encode(0xFE, 0x5A, b"\xfe\xca\x0a\xfe")
    assert frames_in(*chopped(b"\xfe" + inside + b"\xca" + inside, how)) == [inside, inside]


@pytest.mark.parametrize("at", range(SIZE))
def test_every_byte_of_a_frame_counts(at: int) -> None:
    for change in (0x01, 0x80, 0xFF):
        codec = KstCodec()
        broken = REPLY[:at] + bytes((REPLY[at] ^ change,)) + REPLY[at + 1 :]
        assert frames_in(broken, codec=codec) == []
        assert frames_in(READ, codec=codec) == [READ]


def test_another_version_byte_is_no_frame_unless_it_is_the_one_set() -> None:
    """KST RS422, 2: the version byte is a constant."""
    other = encode(0x25, Command.READ_ID, version=0xCB)
    assert frames_in(other) == []
    assert frames_in(other, codec=KstCodec(0xCB)) == [other]
    assert frames_in(READ, codec=KstCodec(0xCB)) == []


@pytest.mark.parametrize(("code", "size"), [(code, size) for code, size in DATA_SIZES.items() if size < DATA_SIZE])
def test_unused_data_bytes_must_be_zero_unless_that_is_ignored(code: int, size: int) -> None:
    """KST RS422, 2.3: unused data bytes are 0."""
    full, over = encode(1, code, b"\1" * size), encode(1, code, b"\1" * (size + 1))
    assert frames_in(full, over, codec=KstCodec()) == [full]
    assert frames_in(full, over, codec=KstCodec(strict=False)) == [full, over]


def test_of_codes_nobody_defines_all_data_is_taken() -> None:
    frame = encode(1, 0x8F, b"12345678")
    assert frames_in(frame) == [frame]


def test_memory_is_bounded_by_one_undecided_frame() -> None:
    codec = KstCodec()
    for byte in b"\xfe\xca" * 500 + b"\xfe" * 500 + bytes(500):
        frames_in(bytes((byte,)), codec=codec)
        assert codec.pending < SIZE
    assert codec.pending + codec.skipped == 2000


def test_reset_forgets_what_was_received() -> None:
    codec = KstCodec()
    assert frames_in(READ[:7], codec=codec) == []
    assert codec.pending == 7
    codec.reset()
    assert codec.pending == 0
    assert frames_in(READ[7:], codec=codec) == []


@steady
@given(
    st.integers(0, 255),
    st.sampled_from(sorted(DATA_SIZES)),
    st.binary(max_size=DATA_SIZE),
    st.binary(max_size=30),
    st.integers(0, 99),
)
def test_what_is_encoded_is_decoded_again(address: int, code: int, data: bytes, junk: bytes, seed: int) -> None:
    data = data[: DATA_SIZES[code]]
    frame = encode(address, code, data)
    codec = KstCodec()
    assert frames_in(*chopped(frame + junk, "random", seed), codec=codec)[0] == frame
    assert frame_of(frame) == Frame(address, code, data.ljust(DATA_SIZE, b"\0"), frame)


@steady
@given(st.binary(max_size=200))
def test_no_input_breaks_it_and_nothing_is_lost_from_the_count(data: bytes) -> None:
    codec = KstCodec()
    whole = b"".join(frames_in(data, codec=codec))
    assert codec.skipped + codec.pending + len(whole) == len(data)


@steady
@given(st.integers(-0x8000, 0x7FFF))
def test_positions_survive_the_way_there_and_back(steps: int) -> None:
    assert decode_position(encode_position(steps) + bytes(6)) == steps


@pytest.mark.parametrize(
    ("address", "code", "data"), [(256, 0, b""), (-1, 0, b""), (0, 256, b""), (0, -1, b""), (0, 0, bytes(9))]
)
def test_what_a_frame_cannot_carry_is_refused(address: int, code: int, data: bytes) -> None:
    with pytest.raises(ValueError, match=r"must each be|do not fit"):
        encode(address, code, data)


def test_a_reply_has_the_key_of_the_command_it_answers() -> None:
    """Replies and refusals of one command can be confused, and nothing else (KST RS422, 2.2)."""
    assert {frame_of(encode(7, code)).key for code in (0x19, 0x59, 0xD9)} == {0x19}
    frame = frame_of(REPLY)
    assert (frame.node, frame.status, frame.refused) == (0x25, None, False)
    assert frame_of(encode(7, 0xC0)).refused
    assert not frame_of(encode(7, 0xBF)).refused


def test_renaming_gives_another_servo_the_same_frame() -> None:
    rng = random.Random(3)
    for _ in range(300):
        other = frame_of(rename(REPLY, rng))
        assert other.address not in (0, 0x25)
        assert (other.code, other.data) == (0x59, REPLY[4:12])
        assert node_of(other.frame) == other.address
    assert frame_of(rename(encode(1, 0x59, version=0xCB), rng)).frame[1] == 0xCB


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"1.02\0\0\0\0", "1.02"),
        (b"V2\0\0\0\0\0\0", "V2"),
        (b"a\0b\0", "61 00 62 00"),
        (b"\x1b[2J", "1b 5b 32 4a"),
        (b"\x01\x02\x03\x04", "01 02 03 04"),
        (b"ab\x7fd", "61 62 7f 64"),
        (bytes(8), "00 00 00 00"),
    ],
)
def test_a_version_is_text_if_all_of_it_can_be_printed(data: bytes, text: str) -> None:
    """KST RS422, 3.8: the version is four bytes of text."""
    assert version_text(data) == text


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        (encode(0x25, 0x09, b"\x93\xff"), "id 37 set position -10.9 deg"),
        (encode(0x25, 0x49, b"\x84\x03"), "id 37 set position ok 90.0 deg"),
        (encode(0, 0x09, b"\0\0"), "all set position 0.0 deg"),
        (READ, "id 37 read position"),
        (REPLY, "id 37 read position ok -10.9 deg"),
        (encode(1, 0x06, b"\6"), "id 1 set baud 6 (512000)"),
        (encode(1, 0x46, b"\x09"), "id 1 set baud ok 9 (no known rate)"),
        (encode(1, 0x08, b"\5"), "id 1 set id 5"),
        (encode(1, 0x58, b"\1"), "id 1 read id ok 1"),
        (encode(1, 0x0F, b"save"), "id 1 save 73 61 76 65"),
        (encode(1, 0x50, b"\1\x80"), "id 1 read status ok 01 80"),
        (encode(1, 0x5A, b"\x1b[2J"), "id 1 read version ok 1b 5b 32 4a"),
        (
            encode(0x25, 0xC9, b"\x06\x09\x00\x30"),
            "id 37 set position refused: 0609 0030 Value range of parameter exceeded (only for write access)",
        ),
        (
            encode(1, 0xD9, b"\x30\x00\x09\x06"),
            "id 1 read position refused: 0609 0030 Value range of parameter exceeded (only for write access)",
        ),
        (encode(1, 0xD9, b"\1\2\3\4"), "id 1 read position refused: unknown abort code, bytes 01 02 03 04"),
        (encode(1, 0x01), "id 1 command 0x01 00 00 00 00 00 00 00 00"),
        (encode(1, 0x81), "id 1 code 0x81, which the protocol does not use: 00 00 00 00 00 00 00 00"),
    ],
)
def test_frames_are_described(frame: bytes, text: str) -> None:
    assert KstCodec().describe(frame, sent=True) == KstCodec().describe(frame, sent=False) == text
    assert describe(frame_of(frame)) == text


@pytest.mark.parametrize("data", [b"", b"\xfe", REPLY[:-1], REPLY + b"\0", b"\0" + REPLY, b"\x1b[2J"])
def test_what_is_no_frame_is_shown_in_hexadecimal(data: bytes) -> None:
    assert KstCodec().describe(data, sent=False) == f"not a KST frame: {data.hex(' ')}"


def test_commands_have_the_names_of_the_specification() -> None:
    assert name_of(0x18) == "read id"
    assert name_of(0x3F) == "command 0x3F"
