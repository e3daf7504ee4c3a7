"""A simulated line: devices on one wire, the time that bytes take on it, and collisions.

The line uses the codec to find where frames end, and knows nothing else about them. An idle line is all ones and a driver pulls
it to zero, so bytes that collide are ANDed. Devices are asked as soon as a request is complete, with the time at which its last
byte will have been sent; a reply is delivered as a whole at the time of its last byte.
"""

from __future__ import annotations

import asyncio
from bisect import insort
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import attrgetter

from servobus.protocols.base import Codec
from servobus.protocols.device import Device, DeviceReply
from servobus.timers import FineTimer, clock_of

TOLERANCE = 0.03
"""Relative difference of two baud rates up to which they understand each other."""
_slot, _begin, _end = attrgetter("slot"), attrgetter("begin"), attrgetter("end")


@dataclass(slots=True)
class Transmission:
    """Bytes that are or will be on the wire, from `begin` to `end`."""

    begin: float
    end: float
    data: bytes


class SimulatedLine:
    """The far end of a line with devices; see `links.base.FarEnd`. `devices` may be changed at any time."""

    def __init__(
        self,
        devices: Sequence[Device],
        codec: Codec,
        loop: asyncio.AbstractEventLoop,
        *,
        baudrate: int,
        wire_time: bool = True,
        four_wires: bool = False,
    ) -> None:
        """Put devices on a line.

        Args:
            codec: finds requests, for the devices' end of the line.
            wire_time: bytes take their time; without it, replies come in the next pass of the loop.
            four_wires: requests and replies travel on different wires and do not collide; two replies still do.
        """
        self.devices = list(devices)
        self.collisions = 0
        """Times that two sent at once."""
        self._codec = codec
        self._loop = loop
        self._now = clock_of(loop)
        self.baudrate = baudrate
        self._byte_time = 10.0 / baudrate
        self._four_wires = four_wires
        self._deliver: Callable[[bytes], None] = _discard
        self._master_until = 0.0
        """Time at which the master's bytes will all have been sent."""
        self._pending: list[Transmission] = []
        """Replies on the wire, ordered by their end. They do not overlap."""
        self._timer = FineTimer(loop, self._on_time) if wire_time else None
        self._closed = False

    def backlog(self) -> float:
        """Return the seconds until all of the master's bytes are sent."""
        return max(0.0, self._master_until - self._now())

    def attach(self, deliver: Callable[[bytes], None]) -> None:
        self._deliver = deliver

    def set_baudrate(self, baudrate: int) -> None:
        """Change the master's rate. Bytes that were on their way at the old rate are lost."""
        if baudrate != self.baudrate:
            self.baudrate = baudrate
            self._byte_time = 10.0 / baudrate
            self._codec.reset()
            self._pending.clear()

    def receive(self, data: bytes) -> None:
        if self._closed:
            return
        if self._timer is None:
            self._receive_at_once(data)
        else:
            self._receive_timed(data, self._timer)

    def close(self) -> None:
        """Neither take nor deliver anything from now on."""
        self._closed = True
        self._pending.clear()
        if self._timer is not None:
            self._timer.close()

    # Without wire time

    def _receive_at_once(self, data: bytes) -> None:
        now = self._now()
        self._codec.receive_data(data)
        while (packet := self._codec.next_reply()) is not None:
            replies = self._ask_devices(packet, now)
            if len(replies) == 1:
                self._send_soon(replies[0])
            else:
                for group in _slots(replies):
                    self._send_soon(self._collided(group))

    def _collided(self, replies: Sequence[DeviceReply]) -> DeviceReply:
        """Return the one reply that arrives of several in the same slot."""
        self.collisions += len(replies) - 1
        data = replies[0].data
        for other in replies[1:]:
            data = blend(data, other.data, 0)
        return DeviceReply(data, late=max(reply.late for reply in replies))

    def _send_soon(self, reply: DeviceReply) -> None:
        if reply.late > 0:
            self._loop.call_later(reply.late, self._send, reply.data)
        else:
            self._loop.call_soon(self._send, reply.data)

    def _send(self, data: bytes) -> None:
        if not self._closed:
            self._deliver(data)

    # With wire time

    def _receive_timed(self, data: bytes, timer: FineTimer) -> None:
        """Send the master's bytes behind those it is still sending, one byte time each."""
        begin = max(self._now(), self._master_until)
        self._master_until = end = begin + len(data) * self._byte_time
        master = Transmission(begin, end, data)
        self._collide_with_replies(master)
        self._codec.receive_data(master.data)
        while (packet := self._codec.next_reply()) is not None:
            rest = min(len(data), self._codec.pending)
            sent_at = end - rest * self._byte_time
            self._schedule_replies(packet, sent_at)
            if self._collide_with_replies(Transmission(sent_at, end, data[len(data) - rest :])):
                self._codec.reset()  # the master did not wait for the reply, so no device understands the rest
        if self._pending:
            timer.arm(self._pending[0].end)

    def _schedule_replies(self, packet: object, sent_at: float) -> None:
        free = sent_at
        for group in _slots(self._ask_devices(packet, sent_at)):
            earliest = free
            for reply in group:
                begin = max(earliest, sent_at + reply.delay + reply.late)
                end = begin + len(reply.data) * self._byte_time
                free = max(free, end)
                self._schedule(Transmission(begin, end, reply.data))

    def _schedule(self, transmission: Transmission) -> None:
        """Put a reply on the wire, merged with the replies that overlap it."""
        for other in [other for other in self._pending if self._overlap(other, transmission)]:
            self.collisions += 1
            self._pending.remove(other)
            transmission = self._merge(other, transmission)
        insort(self._pending, transmission, key=_end)

    def _collide_with_replies(self, master: Transmission) -> bool:
        """Garble replies that the master talks over, and the master's bytes too. Returns whether there were any."""
        hits = [reply for reply in self._pending if not self._four_wires and self._overlap(reply, master)]
        for reply in hits:
            shift = round((reply.begin - master.begin) / self._byte_time)
            master.data, reply.data = overlay(master.data, reply.data, shift), overlay(reply.data, master.data, -shift)
        self.collisions += len(hits)
        return bool(hits)

    def _overlap(self, one: Transmission, other: Transmission) -> bool:
        """Return whether two overlap by more than half a byte."""
        slack = self._byte_time / 2
        return one.begin < other.end - slack and other.begin < one.end - slack

    def _merge(self, one: Transmission, other: Transmission) -> Transmission:
        first, second = sorted((one, other), key=_begin)
        shift = round((second.begin - first.begin) / self._byte_time)
        return Transmission(first.begin, max(one.end, other.end), blend(first.data, second.data, shift))

    def _on_time(self) -> None:
        """Deliver the replies whose last byte has been sent."""
        now = self._now()
        while self._pending and self._pending[0].end <= now:
            self._deliver(self._pending.pop(0).data)
        if self._pending and self._timer:
            self._timer.arm(self._pending[0].end)

    def _ask_devices(self, packet: object, now: float) -> list[DeviceReply]:
        tolerance = TOLERANCE * self.baudrate
        replies: list[DeviceReply] = []
        for device in self.devices:
            if abs(device.baudrate - self.baudrate) <= tolerance:
                replies += device.handle(packet, now)
        return replies


def overlay(data: bytes, other: bytes, shift: int) -> bytes:
    """Return what arrives of `data` if `other`, which begins `shift` bytes later, is on the same wire."""
    return bytes(byte & other[at - shift] if 0 <= at - shift < len(other) else byte for at, byte in enumerate(data))


def blend(first: bytes, second: bytes, shift: int) -> bytes:
    """Return what arrives of both if the second begins `shift` bytes later. A silent line is all ones."""
    return overlay(first.ljust(shift + len(second), b"\xff"), second, shift)


def _slots(replies: Iterable[DeviceReply]) -> list[list[DeviceReply]]:
    """Return the replies grouped by slot, in the order in which they are sent. Those of one slot are sent at once."""
    return [list(group) for _, group in groupby(sorted(replies, key=_slot), key=_slot)]


def _discard(data: bytes) -> None:
    """Drop what is sent while no master is attached."""
