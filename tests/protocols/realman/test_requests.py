"""Modbus requests as the arm's commands: the fewest it can carry, at consecutive addresses."""

from __future__ import annotations

import pytest

from servobus.protocols.modbus.codec import Frame, Function, ModbusCodec, encode, pack
from servobus.protocols.realman.codec import dialect
from servobus.protocols.realman.requests import TunnelRequest


def frame(function: int, data: bytes) -> Frame:
    codec = ModbusCodec("device")
    codec.receive_data(encode(2, function, data))
    result = codec.next_reply()
    assert result is not None
    return result


def reading(address: int, count: int, generation: int = 3) -> TunnelRequest:
    return TunnelRequest(frame(Function.READ_HOLDING, pack((address, count))), dialect(generation, 1))


@pytest.mark.parametrize(("count", "parts"), [(1, [1]), (12, [12]), (13, [12, 1]), (24, [12, 12]), (30, [12, 12, 6])])
def test_a_read_in_parts(count: int, parts: list[int]) -> None:
    request = reading(1145, count)
    sent = [(command.message["address"], command.message.get("num", 1)) for command in request.commands]
    assert sent == [(1145 + sum(parts[:at]), part) for at, part in enumerate(parts)]
    values, answer = list(range(count)), None
    for at in range(len(parts)):
        assert answer is None
        answer = request.take(values[sum(parts[:at]) : sum(parts[: at + 1])])
    assert answer == encode(2, 3, bytes((2 * count,)) + pack(values))


@pytest.mark.parametrize(("count", "parts"), [(1, [1]), (10, [10]), (11, [10, 1]), (23, [10, 10, 3])])
def test_a_write_in_parts(count: int, parts: list[int]) -> None:
    span = pack((1135, count))
    request = TunnelRequest(frame(16, span + bytes((2 * count,)) + pack(range(count))), dialect(3, 1))
    assert [command.message["address"] for command in request.commands] == [1135 + sum(parts[:at]) for at in range(len(parts))]
    answers = [request.take([]) for _ in parts]
    assert answers == [None] * (len(parts) - 1) + [encode(2, 16, span)]


def test_a_single_write_is_answered_by_itself() -> None:
    sent = frame(Function.WRITE_SINGLE, pack((1135, 7)))
    request = TunnelRequest(sent, dialect(3, 1))
    assert [command.message["command"] for command in request.commands] == ["write_single_register"]
    assert request.take([]) == sent.frame


def test_a_part_that_fails_ends_it_as_a_gateway_says_it() -> None:
    request = reading(1145, 24)
    assert request.take(None) == encode(2, 0x83, b"\x0b")
    assert not request.commands


def test_the_new_arm_carries_a_hundred() -> None:
    assert [command.message["num"] for command in reading(1020, 120, 4).commands] == [100, 20]
