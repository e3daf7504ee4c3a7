"""`ADDR:LEN` where a register name is expected."""

from __future__ import annotations

import pytest

from servobus.errors import LimitError
from servobus.protocols.spans import parse_span


def span_of(text: str) -> tuple[int, int] | None:
    return parse_span(text, table_size=256, max_count=16, servo="a")


@pytest.mark.parametrize(("text", "span"), [("0:1", (0, 1)), ("0x1F:16", (31, 16)), ("255:1", (255, 1)), ("010:2", (10, 2))])
def test_an_address_and_a_length_are_a_span(text: str, span: tuple[int, int]) -> None:
    assert span_of(text) == span


@pytest.mark.parametrize("text", ["present_position", "5", "5:", ":5", "-1:2", "0x:1", "1:0x2", "1:2:3", "٣:1", " 1:2"])
def test_anything_else_is_not_a_span(text: str) -> None:
    assert span_of(text) is None


@pytest.mark.parametrize("text", ["0:0", "0:17", "255:2", "256:1", "0xFFFF:1"])
def test_a_span_outside_the_table_or_too_long_is_refused(text: str) -> None:
    with pytest.raises(LimitError, match=r"give ADDR:LEN with LEN 1 to 16, inside addresses 0 to 255"):
        span_of(text)
