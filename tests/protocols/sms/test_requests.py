"""Which replies are due, and which packet answers which request: the right one, and no other."""

from __future__ import annotations

from typing import Any

import pytest

from servobus.protocols.base import Request
from servobus.protocols.sms.codec import BROADCAST_ID, Instruction, Packet, encode
from servobus.protocols.sms.requests import (
    Acknowledged,
    Action,
    Fence,
    Ping,
    PingById,
    Read,
    RegWrite,
    Reset,
    SyncRead,
    SyncWrite,
    Write,
    sync_write_size,
)
from tests.protocols.sms.single_servo import packet_of


def reply(servo: int, params: bytes = b"", status: int = 0) -> Packet:
    return packet_of(encode(servo, status, params))


@pytest.mark.parametrize(
    ("request_", "replies", "nodes"),
    [
        (Ping(1), 1, (1,)),
        (Ping(BROADCAST_ID), 1, ()),
        (Read(1, 0, 5, bytes), 1, (1,)),
        (Write(1, 40, b"\x01"), 1, (1,)),
        (Write(1, 40, b"\x01", answered=False), 0, ()),
        (Write(BROADCAST_ID, 40, b"\x00"), 0, ()),
        (RegWrite(1, 40, b"\x01"), 1, (1,)),
        (RegWrite(1, 40, b"\x01", answered=False), 0, ()),
        (RegWrite(BROADCAST_ID, 40, b"\x01"), 0, ()),
        (Action(), 0, ()),
        (Action(3), 1, (3,)),
        (Action(3, answered=False), 0, ()),
        (Reset(3), 1, (3,)),
        (SyncWrite(40, {1: b"\x00", 2: b"\x00"}), 0, ()),
        (SyncRead(56, 2, [3, 1], dict), 2, (3, 1)),
    ],
    ids=repr,
)
def test_how_many_answer(request_: Request[Any], replies: int, nodes: tuple[int, ...]) -> None:
    assert (request_.replies, request_.nodes) == (replies, nodes)


@pytest.mark.parametrize(
    ("request_", "repeatable"),
    [
        (Ping(1), True),
        (Read(1, 0, 1, bytes), True),
        (Write(1, 42, b"\0"), True),
        (RegWrite(1, 42, b"\0"), True),
        (Action(), False),
        (Reset(1), False),
        (Fence(1, 3), False),
    ],
    ids=repr,
)
def test_which_requests_may_be_repeated(request_: Request[Any], repeatable: bool) -> None:
    assert request_.idempotent is repeatable


@pytest.mark.parametrize(
    "request_",
    [Ping(1), PingById(1), Read(1, 56, 2, bytes), Write(1, 42, b"\0\0"), RegWrite(1, 42, b"\0\0"), Action(1)],
    ids=repr,
)
def test_another_id_or_length_does_not_answer(request_: Request[Any]) -> None:
    size = request_.reply_size - 6
    assert request_.answers(reply(1, bytes(size), status=0x20))
    assert not request_.answers(reply(2, bytes(size)))
    assert not request_.answers(reply(1, bytes(size + 1)))
    if size:
        assert not request_.answers(reply(1, bytes(size - 1)))


def test_ping_gives_the_status() -> None:
    assert Ping(1).parse([reply(1, status=0x21)]) == 0x21
    assert PingById(1).parse([reply(1, b"\x01", status=0x21)]) == 0x21
    assert Ping(BROADCAST_ID).answers(reply(77))


def test_an_acknowledgement_gives_the_status() -> None:
    assert Write(1, 42, b"\0").parse([reply(1, status=4)]) == 4
    assert Write(1, 42, b"\0", answered=False).parse(()) is None


@pytest.mark.parametrize(("address", "size"), [(0, 2), (56, 2), (255, 2)])
def test_a_read_of_two_bytes_is_asked_again_with_three(address: int, size: int) -> None:
    """The echo of a READ is a reply with two parameters."""
    question = Read(1, address, size, lambda data: data)
    assert question.answers(packet_of(question.frame))
    plain = question.plain()
    assert plain is not None
    assert not plain.answers(packet_of(plain.frame))
    assert not plain.answers(packet_of(question.frame))
    memory = bytes(range(256)) + b"\x00"
    first, count = plain.frame[5:7]
    assert plain.parse([reply(1, memory[first : first + count])]) == memory[address : address + size]


def test_ping_has_a_form_whose_echo_cannot_answer() -> None:
    assert Ping(1).answers(packet_of(Ping(1).frame))
    assert not Ping(1).plain().answers(packet_of(Ping(1).plain().frame))
    assert Read(1, 56, 3, bytes).plain() is None
    assert Write(1, 42, b"\0").plain() is None
    assert not Write(1, 42, b"\0").answers(packet_of(Write(1, 42, b"\0").frame))


def test_a_fence_is_answered_by_the_servos_own_id_only() -> None:
    fence = Fence(7, 4)
    assert fence.answers(reply(7, b"\x07\x04\x00\x01"))
    assert not fence.answers(reply(7, b"\x08\x04\x00\x01"))
    assert not fence.answers(reply(7, b"\x07\x04\x00"))
    assert not fence.answers(reply(8, b"\x07\x04\x00\x01"))


def test_reset_is_answered_under_the_old_id_or_under_1() -> None:
    assert [Reset(5).answers(reply(servo)) for servo in (5, 1, 2)] == [True, True, False]
    assert not Reset(5).answers(reply(5, b"\0"))
    with pytest.raises(ValueError, match="name one"):
        Reset(BROADCAST_ID)


def test_sync_read() -> None:
    question = SyncRead(56, 2, [3, 1], dict)
    assert question.frame == encode(BROADCAST_ID, Instruction.SYNC_READ, bytes((56, 2, 3, 1)))
    assert question.partial
    assert [question.answers(reply(servo, b"\0\0")) for servo in (1, 2, 3)] == [True, False, True]
    assert not question.answers(reply(1, b"\0"))
    assert question.parse([reply(3, b"\x03\0"), reply(1, b"\x01\0")]) == {3: b"\x03\0", 1: b"\x01\0"}


def test_sync_write_has_one_span_for_all() -> None:
    assert len(SyncWrite(42, {1: bytes(6), 2: bytes(6)}).frame) == sync_write_size(6, 2)
    for data in ({1: b"\0", 2: b"\0\0"}, {1: b""}):
        with pytest.raises(ValueError, match="same number of bytes"):
            SyncWrite(42, data)


@pytest.mark.parametrize("kind", [Write, RegWrite])
def test_a_write_without_data_is_refused(kind: type[Write] | type[RegWrite]) -> None:
    with pytest.raises(ValueError, match="at least one byte"):
        kind(1, 42, b"")


def test_requests_show_their_frame() -> None:
    assert repr(Ping(1)) == "Ping(ff ff 01 02 01 fb)"
    assert issubclass(Write, Acknowledged)
