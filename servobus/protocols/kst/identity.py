"""Who answers at an address: firmware version, and whether it is one servo or two.

Every new servo has the id 0x25, so two of them on one line speak at once. Nothing in the protocol tells; what can be seen are
answers that are garbled or differ while nothing moves. That makes a clash suspected; it is never excluded.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TypeVar

from servobus.errors import DeviceError, ReplyTimeout
from servobus.protocols.base import Plan, ask
from servobus.protocols.kst.codec import FACTORY_ID, Command, decode_position, version_text
from servobus.protocols.kst.requests import FrameTiming, Read
from servobus.values import Identity

R = TypeVar("R")

LOOKS = 5
"""Reads of version and position each."""
STILL = 10
"""Steps that a servo at rest may seem to move between two reads."""


@dataclass(slots=True)
class Sighting:
    """What was heard from one address when it was asked several times."""

    node: int
    at_rest: bool = True
    """It should not move meanwhile; else only to and fro is strange."""
    versions: list[bytes] = field(default_factory=list)
    positions: list[int] = field(default_factory=list)
    missed: int = 0
    """Questions that brought no whole answer."""

    def reasons(self) -> Iterator[str]:
        if self.missed:
            yield f"{self.missed} of {2 * LOOKS} answers were garbled or missing"
        if len(set(self.versions)) > 1:
            yield "it says different firmware versions"
        if self._jumps():
            yield f"its position jumps between {min(self.positions)} and {max(self.positions)} steps"

    def _jumps(self) -> bool:
        ways = [later - earlier for earlier, later in pairwise(self.positions)]
        to, fro = any(way > STILL for way in ways), any(way < -STILL for way in ways)
        return to or fro if self.at_rest else to and fro

    @property
    def suspicion(self) -> str:
        """Why there may be two servos, and what to do; empty: nothing speaks for it."""
        reasons = ", ".join(self.reasons())
        if not reasons:
            return ""
        new = " (0x25, the id of every new servo)" if self.node == FACTORY_ID else ""
        return (
            f"two servos with id {self.node}{new} are suspected: {reasons}. Connect them one at a time and give each its own id"
        )

    @property
    def firmware(self) -> str | None:
        return version_text(self.versions[0]) if self.versions else None


def look(timing: FrameTiming, node: int, *, at_rest: bool = True) -> Plan[Sighting]:
    """Ask several times. Raises ReplyTimeout where nothing answers at all."""
    seen = Sighting(node, at_rest)
    error: ReplyTimeout | None = None
    for _ in range(LOOKS):
        for question in (
            _note(seen.versions, Read(timing, node, Command.READ_VERSION, _version, once=True)),
            _note(seen.positions, Read(timing, node, Command.READ_POSITION, decode_position, once=True)),
        ):
            try:
                yield from question
            except ReplyTimeout as missed:
                seen.missed, error = seen.missed + 1, missed
            except DeviceError:
                continue  # a refusal is one servo's clear word
    if error is not None and seen.missed == 2 * LOOKS:
        raise error
    return seen


def _note(heard: list[R], request: Read[R]) -> Plan[None]:
    heard.append((yield from ask(request)))


def inspect(timing: FrameTiming, node: int, *, at_rest: bool = True) -> Plan[Identity]:
    """For a scan: with the question whether it is one servo."""
    seen = yield from look(timing, node, at_rest=at_rest)
    return Identity(model="kst", firmware=seen.firmware, notes=tuple(filter(None, (seen.suspicion,))))


def identify(timing: FrameTiming, node: int) -> Plan[Identity]:
    """For a configured servo: in short, unless it has the id of every new one."""
    if node == FACTORY_ID:
        return (yield from inspect(timing, node, at_rest=False))
    try:
        firmware = version_text((yield from ask(Read(timing, node, Command.READ_VERSION, _version))))
    except DeviceError:
        firmware = None  # it answers, and does not know that command
    return Identity(model="kst", firmware=firmware)


def _version(data: bytes) -> bytes:
    return data[:4]
