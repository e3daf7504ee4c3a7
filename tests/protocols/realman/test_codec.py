"""The arm's JSON lines: golden commands of both sets, and which replies answer them."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobus.protocols.realman.codec import (
    MAX_LINE,
    JsonLines,
    dialect,
    encode,
    generation_of,
    is_fence,
    set_voltage,
)

OLD, NEW = dialect(3, 1), dialect(4, 1)

GOLDEN = [
    (OLD.open_mode(115_200, 0.1), b'{"command":"set_modbus_mode","port":1,"baudrate":115200,"timeout":1}\r\n'),
    (OLD.close_mode(), b'{"command":"close_modbus_mode","port":1}\r\n'),
    (OLD.read(2, 1000, 1), b'{"command":"read_holding_registers","port":1,"address":1000,"device":2}\r\n'),
    (
        OLD.read(2, 1145, 6),
        b'{"command":"read_multiple_holding_registers","port":1,"address":1145,"num":6,"device":2}\r\n',
    ),
    (OLD.write(2, 1010, [500]), b'{"command":"write_single_register","port":1,"address":1010,"data":500,"device":2}\r\n'),
    (
        OLD.write(2, 1135, [0, 65535]),
        b'{"command":"write_registers","port":1,"address":1135,"num":2,"data":[0,0,255,255],"device":2}\r\n',
    ),
    (NEW.open_mode(115_200, 0.1), b'{"command":"set_tool_rs485_mode","mode":0,"baudrate":115200}\r\n'),
    (dialect(4, 0).open_mode(9600, 1), b'{"command":"set_controller_rs485_mode","mode":0,"baudrate":9600}\r\n'),
    (
        NEW.read(2, 1145, 6),
        b'{"command":"read_modbus_rtu_holding_registers","address":1145,"device":2,"num":6,"type":1}\r\n',
    ),
    (
        NEW.write(2, 1135, [0, 65535]),
        b'{"command":"write_modbus_rtu_registers","address":1135,"device":2,"type":1,"data":[0,65535]}\r\n',
    ),
    (set_voltage(24), b'{"command":"set_tool_voltage","voltage_type":3}\r\n'),
]


@pytest.mark.parametrize(("command", "line"), GOLDEN)
def test_commands_as_the_documents_have_them(command: Any, line: bytes) -> None:
    assert encode(command.message) == line


def test_limits_of_each_generation() -> None:
    assert [(dialect(number, 1).max_read, dialect(number, 1).max_write) for number in (2, 3, 4)] == [
        (12, 10),
        (12, 10),
        (100, 100),
    ]
    assert NEW.close_mode() is None


ONE, PAIRS, TWO = OLD.read(2, 1, 1), OLD.read(2, 1, 2), NEW.read(2, 1, 2)


@pytest.mark.parametrize(
    ("command", "reply", "registers"),
    [
        (ONE, {"command": "read_holding_registers", "data": 512}, [512]),
        (ONE, {"command": "read_holding_registers", "data": -1}, [65535]),
        (ONE, {"command": "read_holding_registers", "data": 65535}, [65535]),
        (PAIRS, {"command": "read_multiple_holding_registers", "data": [1, 2, 255, 254]}, [258, 65534]),
        (TWO, {"command": "read_modbus_rtu_holding_registers", "data": [258, 65534], "read_state": True}, [258, 65534]),
        (ONE, {"command": "read_holding_registers", "read_state": False}, None),
        (OLD.write(2, 1, [1]), {"command": "write_single_register", "write_state": True}, []),
        (OLD.write(2, 1, [1]), {"command": "write_single_register", "write_state": False}, None),
    ],
)
def test_what_answers(command: Any, reply: dict[str, Any], registers: list[int] | None) -> None:
    assert command.answers(reply)
    assert command.registers(reply) == registers


@pytest.mark.parametrize(
    ("command", "reply"),
    [
        (ONE, {"command": "read_multiple_holding_registers", "data": [1, 2]}),
        (ONE, {"command": "read_holding_registers"}),
        (ONE, {"command": "read_holding_registers", "data": [1, 2]}),
        (ONE, {"command": "read_holding_registers", "data": True}),
        (ONE, {"command": "read_holding_registers", "data": 1.0}),
        (ONE, {"command": "read_holding_registers", "data": 65536}),
        (ONE, {"command": "read_holding_registers", "data": -32769}),
        (PAIRS, {"command": "read_multiple_holding_registers", "data": [1, 2, 3]}),
        (PAIRS, {"command": "read_multiple_holding_registers", "data": [1, 2, 3, 256]}),
        (PAIRS, {"command": "read_multiple_holding_registers", "data": [1, 2, 3, -1]}),
        (PAIRS, {"command": "read_multiple_holding_registers", "data": "abcd"}),
        (TWO, {"command": "read_modbus_rtu_holding_registers", "data": [1]}),
        (OLD.write(2, 1, [1]), {"command": "write_single_register"}),
        (OLD.write(2, 1, [1]), {"command": "write_single_register", "write_state": 1}),
        (OLD.write(2, 1, [1]), {"state": "current_trajectory_state", "write_state": True}),
    ],
)
def test_what_does_not(command: Any, reply: dict[str, Any]) -> None:
    assert not command.answers(reply)


@pytest.mark.parametrize(
    ("reply", "generation"),
    [
        ({"command": "arm_software_info", "ctrl_info": {}}, 3),
        ({"command": "get_arm_software_info", "ctrl_info": {}}, 3),
        ({"command": "arm_software_info", "robot_controller_version": "4.0"}, 4),
        ({"state": "arm_software_version"}, 2),
        ({"command": "read_holding_registers", "data": 4}, None),
        ({}, None),
    ],
)
def test_generations(reply: dict[str, Any], generation: int | None) -> None:
    assert generation_of(reply) == generation
    assert is_fence(reply) is (generation is not None)


@given(st.lists(st.dictionaries(st.text(max_size=5), st.integers() | st.text(max_size=9)), max_size=6), st.data())
def test_lines_come_out_as_they_went_in_however_they_are_cut(messages: list[dict[str, Any]], data: st.DataObject) -> None:
    stream = b"".join(map(encode, messages))
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=8)))
    lines = JsonLines()
    result = [
        message for start, end in zip([0, *cuts], [*cuts, len(stream)], strict=True) for message in lines.feed(stream[start:end])
    ]
    assert result == messages
    assert (lines.skipped, lines.pending) == (0, 0)


@pytest.mark.parametrize(
    "line",
    [
        b'{"command":"x"}\n',
        b"220 welcome\r\n",
        b"[1]\r\n",
        b'{"a":\r\n',
        b'{"a":1}{"a":1}\r\n',
        b"[" * 9000 + b"\r\n",
        b'{"a":' * 3000 + b"\r\n",
        b"\xff\xfe\r\n",
        b"x" * (2 * MAX_LINE) + b"\r\n",
    ],
)
def test_an_invalid_line_is_skipped_and_the_next_one_decoded(line: bytes) -> None:
    lines = JsonLines()
    result = []
    for at in range(0, len(line), 1000):
        result += lines.feed(line[at : at + 1000])
        assert lines.pending <= MAX_LINE + 1000
    assert result == []
    assert lines.feed(b'{"a":1}\r\n') == [{"a": 1}]
    assert lines.skipped == 1
