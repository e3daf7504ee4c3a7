"""Which replies answer a request, and what silence follows it."""

from __future__ import annotations

from typing import Any

import pytest

from servobus.errors import DeviceError, EchoMismatch
from servobus.protocols.base import Request
from servobus.protocols.kst.aborts import OutOfRange
from servobus.protocols.kst.codec import Command, decode_position, encode, encode_position
from servobus.protocols.kst.requests import Fence, Read, RequestSettings, Save, SetValue, UnansweredCommand
from tests.protocols.kst.bench import frame_of

SETTINGS = RequestSettings()


def test_only_the_reply_and_the_refusal_of_its_own_command_answer() -> None:
    """KST RS422, 2.2: a reply has the command's code plus 0x40, a refusal plus 0xC0."""
    request = Read(SETTINGS, 7, Command.READ_POSITION, decode_position)
    accepted = [code for code in range(256) if request.answers(frame_of(encode(7, code)))]
    assert accepted == [0x59, 0xD9]
    assert not request.answers(frame_of(encode(8, 0x59)))


def test_an_echo_is_no_answer() -> None:
    for command in Command:
        request = Read(SETTINGS, 7, command, bytes)
        assert not request.answers(frame_of(request.frame))
        assert request.plain() is None


def test_a_refusal_is_the_error_of_its_code() -> None:
    request = SetValue(SETTINGS, 7, Command.SET_POSITION, encode_position(0))
    with pytest.raises(OutOfRange, match="set position was refused: 0609 0030") as caught:
        request.parse([frame_of(encode(7, 0xC9, b"\x06\x09\x00\x30"))])
    assert caught.value.request is request
    assert caught.value.raw == encode(7, 0xC9, b"\x06\x09\x00\x30")


def test_another_value_than_the_one_sent_is_a_mismatch() -> None:
    """KST RS422, 3.5: the reply repeats the position."""
    request = SetValue(SETTINGS, 7, Command.SET_POSITION, encode_position(-109))
    request.parse([frame_of(encode(7, 0x49, encode_position(-109)))])
    with pytest.raises(EchoMismatch, match="set position: 94 ff was confirmed, 93 ff was sent") as caught:
        request.parse([frame_of(encode(7, 0x49, encode_position(-108)))])
    assert caught.value.raw == encode(7, 0x49, encode_position(-108))
    lenient = SetValue(RequestSettings(strict_echo=False), 7, Command.SET_POSITION, encode_position(-109))
    lenient.parse([frame_of(encode(7, 0x49, encode_position(-108)))])


def test_which_requests_may_be_repeated() -> None:
    position = encode_position(0)
    assert SetValue(SETTINGS, 1, Command.SET_POSITION, position).idempotent
    assert UnansweredCommand(SETTINGS, 1, Command.SET_POSITION, position).idempotent
    assert Read(SETTINGS, 1, Command.READ_ID, bytes).idempotent
    never: list[Request[Any]] = [
        SetValue(SETTINGS, 1, Command.SET_ID, b"\2"),
        SetValue(SETTINGS, 1, Command.SET_BAUD, b"\2"),
        Save(SETTINGS, 1),
        UnansweredCommand(SETTINGS, 1, Command.SAVE, b"save"),
        Fence(SETTINGS, 1, Command.READ_ID, (1,)),
        Read(SETTINGS, 1, Command.READ_ID, bytes, once=True),
    ]
    assert not any(request.idempotent for request in never)


def test_the_reply_to_a_new_id_may_come_from_the_new_id() -> None:
    """KST RS422, 3.1, 3.2: a change is in effect after save and restart."""
    reply = frame_of(encode(5, 0x48, b"\5"))
    assert not SetValue(SETTINGS, 1, Command.SET_ID, b"\5").answers(reply)
    request = SetValue(SETTINGS, 1, Command.SET_ID, b"\5", also=5)
    assert request.answers(reply)
    assert request.answers(frame_of(encode(1, 0x48, b"\5")))
    assert not request.answers(frame_of(encode(5, 0x58, b"\5")))


def test_a_fence_is_passed_by_any_answer_to_it_but_another_id() -> None:
    fence = Fence(SETTINGS, 7, Command.READ_ID, (7, 9))
    assert fence.answers(frame_of(encode(7, 0x58, b"\7")))
    assert fence.answers(frame_of(encode(7, 0x58, b"\x09")))
    assert fence.answers(frame_of(encode(7, 0xD8, b"\x06\x06\x00\x00")))
    assert not fence.answers(frame_of(encode(7, 0x58, b"\x08")))
    assert not fence.answers(frame_of(encode(7, 0x5A, b"\7")))
    other = Fence(SETTINGS, 7, Command.READ_VERSION, (7,))
    assert other.answers(frame_of(encode(7, 0x5A, b"1.00")))
    refused = frame_of(encode(7, 0xDA, b"\x06\x06\x00\x00"))
    assert other.answers(refused)
    other.parse([refused])
    assert not SETTINGS.aborts.faulty


def test_silence_after_what_is_not_answered() -> None:
    """The document gives no times, so the line stays silent as long as a reply could take."""
    settings = RequestSettings(gap=0.001, guard=0.004, flash_time=0.3)
    assert Read(settings, 1, Command.READ_ID, bytes).quiet_after == 0.001
    assert UnansweredCommand(settings, 1, Command.SET_POSITION, bytes(2)).quiet_after == 0.004
    assert UnansweredCommand(settings, 1, Command.SAVE, b"save").quiet_after == 0.3
    assert UnansweredCommand(RequestSettings(guard=0.004, flash_time=0), 1, Command.SAVE, b"save").quiet_after == 0.004
    assert (Save(settings, 1).service_time, Save(settings, 1).quiet_after) == (0.3, 0.3)
    assert UnansweredCommand(settings, 1, Command.SAVE, b"save").parse(()) is None
    with pytest.raises(DeviceError):
        Save(settings, 1).parse([frame_of(encode(1, 0xCF, b"\x08\x00\x00\x20"))])


def test_requests_show_their_frame() -> None:
    assert repr(Read(SETTINGS, 0x25, Command.READ_ID, bytes)) == "Read(fe ca 25 18 00 00 00 00 00 00 00 00 07 0a)"
