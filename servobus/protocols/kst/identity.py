"""Who answers at an address: the firmware version, and whether it may be two servos.

Every new servo has the id 0x25, so two of them on one line reply at once. The protocol cannot tell that. What shows it are
replies that are garbled, or that differ while nothing moves. So a clash can be suspected, and is never excluded.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TypeVar

from servobus.errors import DeviceError, ReplyTimeout
from servobus.protocols.base import Plan, ask
from servobus.protocols.kst.codec import FACTORY_ID, Command, decode_position, version_text
from servobus.protocols.kst.requests import Read, RequestSettings
from servobus.values import Identity

R = TypeVar("R")

ROUNDS = 5
"""Reads of the version and of the position."""
JITTER = 10
"""Steps by which two readings of a servo at rest may differ."""


@dataclass(slots=True)
class Observation:
    """What one address answered when it was asked several times."""

    node: int
    at_rest: bool = True
    """It does not move meanwhile. Of a servo that may move, only movement in both directions is suspicious."""
    versions: list[bytes] = field(default_factory=list)
    positions: list[int] = field(default_factory=list)
    missed: int = 0
    """Requests without a valid reply."""

    def reasons(self) -> Iterator[str]:
        if self.missed:
            yield f"{self.missed} of {2 * ROUNDS} replies were garbled or missing"
        if len(set(self.versions)) > 1:
            yield "it reports different firmware versions"
        if self._jumps():
            yield f"its position jumps between {min(self.positions)} and {max(self.positions)} steps"

    def _jumps(self) -> bool:
        changes = [later - earlier for earlier, later in pairwise(self.positions)]
        up, down = any(change > JITTER for change in changes), any(change < -JITTER for change in changes)
        return up or down if self.at_rest else up and down

    @property
    def suspicion(self) -> str:
        """Why it may be two servos, and what to do; empty where nothing suggests it."""
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


def observe(settings: RequestSettings, node: int, *, at_rest: bool = True) -> Plan[Observation]:
    """Ask an address for its version and position several times. Raises ReplyTimeout where nothing answers at all."""
    result = Observation(node, at_rest)
    error: ReplyTimeout | None = None
    for _ in range(ROUNDS):
        for question in (
            _append(result.versions, Read(settings, node, Command.READ_VERSION, _version, once=True)),
            _append(result.positions, Read(settings, node, Command.READ_POSITION, decode_position, once=True)),
        ):
            try:
                yield from question
            except ReplyTimeout as timeout:
                result.missed, error = result.missed + 1, timeout
            except DeviceError:
                continue  # a refusal is a valid reply of one servo
    if error is not None and result.missed == 2 * ROUNDS:
        raise error
    return result


def _append(values: list[R], request: Read[R]) -> Plan[None]:
    values.append((yield from ask(request)))


def inspect(settings: RequestSettings, node: int, *, at_rest: bool = True) -> Plan[Identity]:
    """Identify an address for a scan, and check whether it may be two servos."""
    result = yield from observe(settings, node, at_rest=at_rest)
    return Identity(model="kst", firmware=result.firmware, notes=tuple(filter(None, (result.suspicion,))))


def identify(settings: RequestSettings, node: int) -> Plan[Identity]:
    """Identify a configured servo: by one read, unless it has the id of every new servo."""
    if node == FACTORY_ID:
        return (yield from inspect(settings, node, at_rest=False))
    try:
        firmware = version_text((yield from ask(Read(settings, node, Command.READ_VERSION, _version))))
    except DeviceError:
        firmware = None  # it answers, and does not have that command
    return Identity(model="kst", firmware=firmware)


def _version(data: bytes) -> bytes:
    return data[:4]
