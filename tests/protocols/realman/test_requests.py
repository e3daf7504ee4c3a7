"""Modbus questions as commands: as few as the arm carries, addresses that go on where the last ended."""

from __future__ import annotations

import pytest

from servobus.protocols.modbus.codec import Frame, Function, ModbusCodec, encode, pack
from servobus.protocols.realman.codec import dialect
from servobus.protocols.realman.requests import Question


def frame(function: int, body: bytes) -> Frame:
    codec = ModbusCodec("device")
    codec.receive_data(encode(2, function, body))
    found = codec.next_reply()
    assert found is not None
    return found


def reading(address: int, count: int, generation: int = 3) -> Question:
    return Question(frame(Function.READ_HOLDING, pack((address, count))), dialect(generation, 1))


@pytest.mark.parametrize(("count", "parts"), [(1, [1]), (12, [12]), (13, [12, 1]), (24, [12, 12]), (30, [12, 12, 6])])
def test_a_read_in_parts(count: int, parts: list[int]) -> None:
    question = reading(1145, count)
    asked = [(step.message["address"], step.message.get("num", 1)) for step in question.steps]
    assert asked == [(1145 + sum(parts[:at]), part) for at, part in enumerate(parts)]
    values, answer = list(range(count)), None
    for at in range(len(parts)):
        assert answer is None
        answer = question.take(values[sum(parts[:at]) : sum(parts[: at + 1])])
    assert answer == encode(2, 3, bytes((2 * count,)) + pack(values))


@pytest.mark.parametrize(("count", "parts"), [(1, [1]), (10, [10]), (11, [10, 1]), (23, [10, 10, 3])])
def test_a_write_in_parts(count: int, parts: list[int]) -> None:
    told = pack((1135, count))
    question = Question(frame(16, told + bytes((2 * count,)) + pack(range(count))), dialect(3, 1))
    assert [step.message["address"] for step in question.steps] == [1135 + sum(parts[:at]) for at in range(len(parts))]
    answers = [question.take([]) for _ in parts]
    assert answers == [None] * (len(parts) - 1) + [encode(2, 16, told)]


def test_a_single_write_is_answered_by_itself() -> None:
    asked = frame(Function.WRITE_SINGLE, pack((1135, 7)))
    question = Question(asked, dialect(3, 1))
    assert [step.message["command"] for step in question.steps] == ["write_single_register"]
    assert question.take([]) == asked.frame


def test_a_part_that_fails_ends_it_as_a_gateway_says_it() -> None:
    question = reading(1145, 24)
    assert question.take(None) == encode(2, 0x83, b"\x0b")
    assert not question.steps


def test_the_new_arm_carries_a_hundred() -> None:
    assert [step.message["num"] for step in reading(1020, 120, 4).steps] == [100, 20]
