"""`ADDR:LEN`: a piece of the memory table where a register name is expected."""

from __future__ import annotations

import re

from servobus.errors import LimitError

SPAN = re.compile(r"(0[xX][0-9a-fA-F]{1,8}|[0-9]{1,9}):([0-9]{1,9})")


def parse_span(text: str, *, table_size: int, max_count: int, servo: str) -> tuple[int, int] | None:
    """Return address and length of an `ADDR:LEN` (decimal, or hexadecimal address); None where the text is something else.

    Raises LimitError where the span leaves the memory table (addresses 0 to `table_size` - 1) or is longer than one read carries.
    """
    match = SPAN.fullmatch(text)
    if match is None:
        return None
    address, count = int(match[1], 16 if match[1][:2] in ("0x", "0X") else 10), int(match[2])
    if not (1 <= count <= max_count and address + count <= table_size):
        raise LimitError(
            f"{text} does not fit: give ADDR:LEN with LEN 1 to {max_count}, inside addresses 0 to {table_size - 1}", servo=servo
        )
    return address, count
