"""The fewest reads and writes that carry some registers. Pure arithmetic of addresses.

A read may run over registers nobody asked for, where that costs less than a second turn; a write never does.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

WORTHWHILE = 26
"""Words nobody asked for that cost as much as one more turn at 115200 baud: 13 bytes and two silences of 1.75 ms."""


@dataclass(slots=True)
class Limits:
    """Registers that the line carries in one question; known for sure when it is up."""

    read: int
    write: int


@dataclass(frozen=True, slots=True)
class Span:
    """Registers one behind the other."""

    start: int
    count: int

    @property
    def end(self) -> int:
        return self.start + self.count

    def holds(self, address: int) -> bool:
        return self.start <= address < self.end


def read_spans(addresses: Iterable[int], limit: int) -> list[Span]:
    """Everything in these addresses, in as few reads as are worth it."""
    return _joined(addresses, limit, WORTHWHILE)


def write_spans(addresses: Iterable[int], limit: int) -> list[Span]:
    """These addresses and no other."""
    return _joined(addresses, limit, 0)


def _joined(addresses: Iterable[int], limit: int, idle: int) -> list[Span]:
    spans: list[Span] = []
    for address in sorted(set(addresses)):
        last = spans[-1] if spans else None
        if last and address - last.end <= idle and address + 1 - last.start <= limit:
            spans[-1] = Span(last.start, address + 1 - last.start)
        else:
            spans.append(Span(address, 1))
    return spans


def cut(span: Span, words: Sequence[int], address: int) -> int:
    """The word at this address."""
    return words[address - span.start]
