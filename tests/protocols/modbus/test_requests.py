"""Requests, and which frames answer them. Golden frames: the examples of ROH Modbus, with their high and low bytes in order."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobus.errors import DeviceError
from servobus.protocols.modbus.codec import MAX_READ, MAX_WRITE, Frame, ModbusCodec, encode, pack
from servobus.protocols.modbus.requests import (
    EXCEPTIONS,
    MIN_GAP,
    Fence,
    PresenceRead,
    ReadHolding,
    RtuTiming,
    UnansweredWrite,
    UnitRead,
    WriteMultiple,
    WriteSingle,
)

TIMING = RtuTiming()


def frame(text: str | bytes) -> Frame:
    data = bytes.fromhex(text) if isinstance(text, str) else text
    codec = ModbusCodec()
    codec.receive_data(data)
    reply = codec.next_reply()
    assert reply is not None
    assert reply.frame == data
    return reply


def read(address: int, count: int, unit: int = 2) -> ReadHolding[list[int]]:
    return ReadHolding(TIMING, unit, address, count, list)


# Golden frames


@pytest.mark.parametrize(
    ("request_", "text"),
    [
        (read(0x6B, 2, 0x11), "11 03 00 6b 00 02 b7 47"),
        (WriteSingle(TIMING, 0x11, 0x6B, 0x1000), "11 06 00 6b 10 00 f7 46"),
        (WriteMultiple(TIMING, 0x11, 1, [0x000A, 0x0102]), "11 10 00 01 00 02 04 00 0a 01 02 c6 f0"),
        (read(1000, 1), "02 03 03 e8 00 01 04 49"),
        (WriteMultiple(TIMING, 2, 1135, [0] * 5 + [65535]), "02 10 04 6f 00 06 0c" + " 00" * 10 + " ff ff 60 3e"),
        (WriteMultiple(TIMING, 2, 1125, [0] * 5 + [65535]), "02 10 04 65 00 06 0c" + " 00" * 10 + " ff ff e6 99"),
        (WriteSingle(TIMING, 2, 1010, 500), "02 06 03 f2 01 f4 28 59"),
        (read(1006, 1), "02 03 03 ee 00 01 e4 48"),
        (WriteSingle(TIMING, 0, 1010, 500), "00 06 03 f2 01 f4 29 bb"),
    ],
)
def test_questions(request_: ReadHolding[list[int]] | WriteSingle | WriteMultiple, text: str) -> None:
    assert request_.frame == bytes.fromhex(text)
    assert request_.frame.hex(" ") in repr(request_)


def test_the_seeds_answers() -> None:
    asked = read(0x6B, 2, 0x11)
    assert asked.parse([frame(encode(0x11, 3, b"\x04\0\1\0\2"))]) == [1, 2]
    assert WriteMultiple(TIMING, 0x11, 1, [10, 0x102]).answers(frame(encode(0x11, 0x10, pack((1, 2)))))


@pytest.mark.parametrize(("text", "word"), [("02 03 02 01 00 fd d4", 0x0100), ("02 03 02 03 00 fc b4", 0x0300)])
def test_the_first_register(text: str, word: int) -> None:
    assert read(1000, 1).answers(frame(text))
    assert read(1000, 1).parse([frame(text)]) == [word]


def test_a_write_of_six_and_its_answers() -> None:
    asked = WriteMultiple(TIMING, 2, 1135, [0] * 6)
    yes, no = frame("02 10 04 6f 00 06 71 15"), frame("02 90 04 bd c3")
    assert asked.answers(yes)
    asked.parse([yes])
    assert asked.answers(no)
    with pytest.raises(DeviceError, match=r"unit 2 refused: device failure \(4\)") as caught:
        asked.parse([no])
    assert (caught.value.code, caught.value.request, caught.value.raw) == (4, asked, no.frame)


# What is no answer


def test_an_answer_fits_in_unit_function_count_and_echo() -> None:
    """Catalogue 12."""
    asked = read(1145, 6)
    right = encode(2, 3, b"\x0c" + bytes(12))
    assert asked.answers(frame(right))
    wrong = [
        encode(3, 3, b"\x0c" + bytes(12)),
        encode(2, 3, b"\x0a" + bytes(10)),
        encode(2, 3, b"\x0e" + bytes(14)),
        encode(2, 6, pack((1145, 6))),
        encode(2, 16, pack((1145, 6))),
        encode(2, 0x90, b"\1"),
        encode(3, 0x83, b"\1"),
    ]
    assert not any(asked.answers(frame(data)) for data in wrong)
    write = WriteMultiple(TIMING, 2, 1135, [1, 2])
    for data in (pack((1134, 2)), pack((1135, 1)), pack((1135, 3))):
        assert not write.answers(frame(encode(2, 16, data)))
    single = WriteSingle(TIMING, 2, 1135, 9)
    for data in (pack((1134, 9)), pack((1135, 8))):
        assert not single.answers(frame(encode(2, 6, data)))
    assert single.answers(frame(single.frame))


@pytest.mark.parametrize("address", range(0x300, 0x400, 15))
def test_the_echo_of_a_read_is_no_answer(address: int) -> None:
    """The write reply for these registers looks like a read reply of three bytes."""
    for count in range(1, 5):
        asked = read(address, count)
        assert not asked.answers(frame(asked.frame))
        assert asked.plain() is None


def test_the_echo_of_a_write_of_many_is_no_answer() -> None:
    asked = WriteMultiple(TIMING, 2, 1135, [1, 2])
    assert not asked.answers(frame(asked.frame))
    assert asked.plain() is None


def test_only_a_single_write_is_answered_by_itself() -> None:
    assert WriteSingle(TIMING, 2, 1135, 9).mirrored
    assert not WriteMultiple(TIMING, 2, 1135, [9]).mirrored


@given(st.integers(1, MAX_READ), st.integers(1, MAX_READ))
def test_only_replies_that_can_be_confused_have_the_same_key(one: int, other: int) -> None:
    late = frame(encode(2, 3, bytes((2 * one,)) + bytes(2 * one)))
    asked = read(1000, other)
    assert asked.answers(late) == (one == other) == (asked.reply_key == late.key)


# Refusals


@pytest.mark.parametrize("code", [*EXCEPTIONS, 0x40])
def test_exceptions_have_names(code: int) -> None:
    with pytest.raises(DeviceError, match=EXCEPTIONS.get(code, "of its own")) as caught:
        read(1, 1).parse([frame(encode(2, 0x83, bytes((code,))))])
    assert caught.value.code == code


def test_a_units_refusal_shows_it_is_there_and_a_gateways_does_not() -> None:
    probe = PresenceRead(TIMING, 2, 1000, 1, list)
    assert probe.parse([frame("02 03 02 01 00 fd d4")]) == [0x100]
    for code in (1, 4):
        refused = frame(encode(2, 0x83, bytes((code,))))
        assert probe.answers(refused)
        assert probe.parse([refused]) is None
    for code in (0x0A, 0x0B):
        assert not probe.answers(frame(encode(2, 0x83, bytes((code,)))))
        assert read(1000, 1).is_silence([frame(encode(2, 0x83, bytes((code,))))])
    assert not read(1000, 1).is_silence([refused])


def test_a_gateways_refusal_is_silence_where_only_the_unit_itself_may_answer() -> None:
    """0x0A and 0x0B are sent in the unit's name and say nothing about it ("Modbus application protocol", 7)."""
    asked = UnitRead(TIMING, 2, 1000, 1, list)
    assert [asked.answers(frame(encode(2, 0x83, bytes((code,))))) for code in (2, 4, 0x0A, 0x0B)] == [True, True, False, False]
    with pytest.raises(DeviceError):
        asked.parse([frame(encode(2, 0x83, b"\4"))])


@pytest.mark.parametrize("refusable", [True, False])
def test_a_fence_takes_a_refusal_only_when_no_other_read_can_have_it(refusable: bool) -> None:
    fence = Fence(TIMING, 2, 1000, 2, list, refusable=refusable)
    assert not fence.idempotent
    assert fence.answers(frame(encode(2, 0x83, b"\4"))) == refusable
    assert fence.answers(frame(encode(2, 3, b"\4" + bytes(4))))


# Silence


def test_frames_are_apart() -> None:
    assert read(1, 1).quiet_after == MIN_GAP
    assert RtuTiming.at(115_200).gap == RtuTiming.at(22_000).gap == MIN_GAP
    assert RtuTiming.at(19_200).gap == pytest.approx(3.5 * 11 / 19_200)
    assert WriteMultiple(RtuTiming.at(9_600), 2, 1, [1]).quiet_after == pytest.approx(3.5 * 11 / 9_600)


def test_a_broadcast_has_no_reply_and_a_longer_silence() -> None:
    timing = RtuTiming.at(115_200, 0.2)
    for asked in (WriteSingle(timing, 0, 1010, 500), WriteMultiple(timing, 0, 1010, [500])):
        assert (asked.replies, asked.nodes) == (0, ())
        assert asked.quiet_after == pytest.approx(MIN_GAP + 0.2)
        asked.parse(())


def test_an_unanswered_write_leaves_time_for_a_reply() -> None:
    write = UnansweredWrite(RtuTiming.at(115_200), 2, 1135, [1])
    assert write.frame == WriteMultiple(TIMING, 2, 1135, [1]).frame
    assert (write.replies, write.nodes) == (0, ())
    assert 0.005 < write.quiet_after < 0.01
    write.parse(())


# Edges


@pytest.mark.parametrize("count", [1, MAX_READ])
def test_reads_at_the_edge(count: int) -> None:
    assert read(0, count).reply_size == 5 + 2 * count


@pytest.mark.parametrize(("unit", "count"), [(2, 0), (2, MAX_READ + 1), (0, 1)])
def test_reads_beyond_the_edge(unit: int, count: int) -> None:
    with pytest.raises(ValueError, match="1 to 125"):
        read(0, count, unit)


@pytest.mark.parametrize("count", [1, MAX_WRITE])
def test_writes_at_the_edge(count: int) -> None:
    assert len(WriteMultiple(TIMING, 2, 0, [0] * count).frame) == 9 + 2 * count


@pytest.mark.parametrize("count", [0, MAX_WRITE + 1])
def test_writes_beyond_the_edge(count: int) -> None:
    with pytest.raises(ValueError, match="1 to 123"):
        WriteMultiple(TIMING, 2, 0, [0] * count)


@given(st.integers(1, 247), st.integers(0, 65400), st.lists(st.integers(0, 65535), min_size=1, max_size=MAX_WRITE))
def test_round_trip(unit: int, address: int, values: list[int]) -> None:
    codec = ModbusCodec("device")
    for asked in (WriteMultiple(TIMING, unit, address, values), WriteSingle(TIMING, unit, address, values[0])):
        codec.receive_data(asked.frame)
        reply = codec.next_reply()
        assert reply is not None
        assert (reply.unit, reply.frame) == (unit, asked.frame)
    reply = frame(encode(unit, 3, bytes((2 * len(values),)) + pack(values)))
    assert read(address, len(values), unit).parse([reply]) == values
