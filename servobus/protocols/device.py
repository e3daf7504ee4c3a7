"""The interface of a simulated device: the other end of a protocol's frames. Sans-IO."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol


@dataclass(frozen=True, slots=True)
class DeviceReply:
    """What a simulated device sends: `delay` seconds after the end of the request, and after the replies of lower slots."""

    data: bytes
    delay: float = 0.0
    slot: int = 0
    late: float = 0.0
    """More delay, caused by a fault: it counts also on a line whose bytes take no time."""


class Device(Protocol):
    """A simulated node: the other end of the same frames and the same register map. Sans-IO; the caller passes the time."""

    @property
    def node(self) -> int: ...

    @property
    def baudrate(self) -> int:
        """The rate it is set to; it understands no other."""

    def handle(self, packet: Any, now: float) -> Sequence[DeviceReply]:
        """Return the replies to a whole valid frame, which may be for another node. `now`: monotonic seconds."""
