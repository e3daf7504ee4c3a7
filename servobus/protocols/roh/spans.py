"""The fewest reads and writes that carry given registers. Pure arithmetic with addresses.

A read may cover registers that are not wanted, if that costs less than a second turn. A write never does.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

MAX_UNWANTED = 26
"""Unwanted registers between two wanted ones that cost as much as another turn at 115200 baud: 13 bytes and two gaps of 1.75
ms."""


@dataclass(slots=True)
class Limits:
    """Registers of one request; final when the line is open."""

    read: int
    write: int


@dataclass(frozen=True, slots=True)
class Span:
    """Consecutive registers."""

    start: int
    count: int

    @property
    def end(self) -> int:
        return self.start + self.count

    def contains(self, address: int) -> bool:
        return self.start <= address < self.end


def read_spans(addresses: Iterable[int], limit: int, gap: int | None = None) -> list[Span]:
    """Return the cheapest reads of all these addresses. `gap`: no read runs across this address, which the hand may not have."""
    if gap is None:
        return _joined(addresses, limit, MAX_UNWANTED)
    wanted = set(addresses)
    below = {address for address in wanted if address < gap}
    return [*_joined(below, limit, MAX_UNWANTED), *_joined(wanted - below, limit, MAX_UNWANTED)]


def write_spans(addresses: Iterable[int], limit: int) -> list[Span]:
    """Return the fewest writes of these addresses and no others."""
    return _joined(addresses, limit, 0)


def _joined(addresses: Iterable[int], limit: int, max_unwanted: int) -> list[Span]:
    spans: list[Span] = []
    for address in sorted(set(addresses)):
        last = spans[-1] if spans else None
        if last and address - last.end <= max_unwanted and address + 1 - last.start <= limit:
            spans[-1] = Span(last.start, address + 1 - last.start)
        else:
            spans.append(Span(address, 1))
    return spans
