"""SMS packets: the frames of the document, and a stream in which anything may stand between them."""

from __future__ import annotations

import random
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobus.protocols.base import Request
from servobus.protocols.sms.codec import MAX_PARAMETERS, Packet, SmsCodec, checksum, describe, encode, node_of, rename
from tests.protocols.sms.golden import REPLIES, REQUESTS

PING = encode(1, 1)
ANSWER = encode(1, 0, b"\x18\x05")


def decoded(*chunks: bytes) -> list[Packet]:
    codec = SmsCodec()
    packets = []
    for chunk in chunks:
        codec.receive_data(chunk)
        while (packet := codec.next_reply()) is not None:
            packets.append(packet)
    return packets


@pytest.mark.parametrize(("request_", "text"), REQUESTS.values(), ids=REQUESTS)
def test_requests_are_the_frames_of_the_document(request_: Request[Any], text: str) -> None:
    assert request_.frame == bytes.fromhex(text)


@pytest.mark.parametrize(("request_", "text"), REQUESTS.values(), ids=REQUESTS)
def test_the_frames_are_understood(request_: Request[Any], text: str) -> None:
    (packet,) = decoded(bytes.fromhex(text))
    assert packet.id == request_.node
    assert encode(packet.id, packet.code, packet.params) == packet.frame == request_.frame


@pytest.mark.parametrize(("request_", "text", "value"), REPLIES.values(), ids=REPLIES)
def test_replies_of_the_document_answer(request_: Request[Any], text: str, value: object) -> None:
    (packet,) = decoded(bytes.fromhex(text))
    assert request_.answers(packet)
    assert request_.parse([packet]) == value


def test_the_parts_of_a_packet() -> None:
    (packet,) = decoded(encode(5, 0x20, b"\x01\x02"))
    assert (packet.node, packet.status, packet.key, packet.params) == (5, 0x20, 2, b"\x01\x02")
    assert node_of(packet.frame) == 5
    assert checksum(b"\xfe\x02\x05") == 0xFA


@pytest.mark.parametrize("cut", range(1, len(ANSWER)))
def test_cut_anywhere(cut: int) -> None:
    assert decoded(ANSWER[:cut], ANSWER[cut:]) == decoded(ANSWER)


def test_byte_by_byte() -> None:
    stream = PING + ANSWER + encode(0, 0xFF, b"\xff" * 5)
    assert [packet.frame for packet in decoded(*(bytes((byte,)) for byte in stream))] == [
        PING,
        ANSWER,
        encode(0, 0xFF, b"\xff" * 5),
    ]


@pytest.mark.parametrize("junk", [b"\x00", b"\xff", b"\xff\xff", b"\xff\xff\xff\xff", b"\x55\xaa\xff", b"\xff\x00\xff"])
def test_junk_before_a_packet_is_skipped(junk: bytes) -> None:
    assert [packet.frame for packet in decoded(junk + ANSWER)] == [ANSWER]
    assert [packet.frame for packet in decoded(junk, ANSWER)] == [ANSWER]


def test_a_packet_after_a_wrong_checksum_is_decoded() -> None:
    wrong = ANSWER[:-1] + bytes((ANSWER[-1] ^ 1,))
    assert [packet.frame for packet in decoded(wrong + ANSWER)] == [ANSWER]


def test_a_packet_inside_a_broken_one_is_decoded() -> None:
    long = encode(3, 0, bytes(40))
    assert [packet.frame for packet in decoded(long[:20] + ANSWER + bytes(60))] == [ANSWER]


@pytest.mark.parametrize("head", [b"\xff\xff\xff\x02", b"\xff\xff\x01\x00", b"\xff\xff\x01\x01"])
def test_an_impossible_header_is_skipped(head: bytes) -> None:
    codec = SmsCodec()
    codec.receive_data(head + bytes(4))
    assert codec.next_reply() is None
    assert codec.pending == 0
    assert codec.skipped == len(head) + 4


def test_the_longest_packet_and_one_more() -> None:
    longest = encode(1, 3, bytes(MAX_PARAMETERS))
    assert len(longest) == 259
    assert decoded(longest)[0].frame == longest
    with pytest.raises(ValueError, match="254 parameters do not fit"):
        encode(1, 3, bytes(MAX_PARAMETERS + 1))


@pytest.mark.parametrize("servo", [-1, 255])
def test_ids_that_no_frame_carries(servo: int) -> None:
    with pytest.raises(ValueError, match=f"id {servo} is outside 0 to 253"):
        encode(servo, 1)


def test_memory_is_bounded() -> None:
    codec, rng = SmsCodec(), random.Random(1)
    for _ in range(2000):
        codec.receive_data(rng.randbytes(50))
        while codec.next_reply() is not None:
            pass
        assert codec.pending < 259
    codec.reset()
    assert codec.pending == 0


@given(st.integers(0, 253), st.integers(0, 255), st.binary(max_size=MAX_PARAMETERS), st.binary(max_size=3))
def test_encoded_packets_are_decoded(servo: int, code: int, params: bytes, junk: bytes) -> None:
    frame = encode(servo, code, params)
    assert (servo, code, params, frame) in decoded(junk + frame + frame) or junk.endswith(b"\xff") or b"\xff\xff" in junk
    assert decoded(frame) == [(servo, code, params, frame)]


@given(st.integers(0, 253), st.binary(max_size=20), st.integers(0, 10_000))
def test_renaming_changes_the_id_and_nothing_else(servo: int, params: bytes, seed: int) -> None:
    (packet,) = decoded(rename(encode(servo, 0, params), random.Random(seed)))
    assert packet.id != servo
    assert packet.params == params


@pytest.mark.parametrize(
    ("frame", "sent", "text"),
    [
        (PING, True, "id 1 PING"),
        (encode(0xFE, 5), True, "all ACTION"),
        (encode(1, 2, b"\x38\x02"), True, "id 1 READ 0x38 2 bytes"),
        (encode(1, 3, b"\x2a\x00\x08"), True, "id 1 WRITE 0x2A = 00 08"),
        (encode(1, 4, b"\x2a\x00\x08"), True, "id 1 REG_WRITE 0x2A = 00 08"),
        (encode(0xFE, 0x82, b"\x38\x02\x01\x02"), True, "all SYNC_READ 0x38 2 bytes of ids 1, 2"),
        (encode(0xFE, 0x83, b"\x28\x01\x01\x00\x02\x01"), True, "all SYNC_WRITE 0x28 id 1 = 00, id 2 = 01"),
        (encode(1, 0x77, b"\x01"), True, "id 1 instruction 0x77 01"),
        (ANSWER, False, "id 1 ok data 18 05"),
        (encode(1, 0x20), False, "id 1 status 0x20"),
        (b"\x01\x02", False, "no SMS packet: 01 02"),
        (PING + b"\x00", True, "no SMS packet: ff ff 01 02 01 fb 00"),
    ],
)
def test_packets_are_described(frame: bytes, sent: bool, text: str) -> None:
    assert describe(frame, sent=sent) == SmsCodec().describe(frame, sent=sent) == text
