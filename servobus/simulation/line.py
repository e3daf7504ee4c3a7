"""A simulated line: devices on one wire, with the time that bytes take on it and what happens when two speak at once.

It knows frames only as far as the codec finds their ends. A line idles at ones and a driver pulls it to zero, so bytes that meet
are ANDed. Devices are lazy, so a request is handed to them as soon as it is known, with the time at which its last byte will have
been said; what they answer is delivered whole when its last byte would have come.
"""

from __future__ import annotations

import asyncio
from bisect import insort
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import attrgetter

from servobus.protocols.base import Codec, Device, DeviceReply
from servobus.timers import FineTimer, clock_of

TOLERANCE = 0.03
"""How far two baud rates may be apart and still understand each other."""
_slot, _begin, _end = attrgetter("slot"), attrgetter("begin"), attrgetter("end")


@dataclass(slots=True)
class Saying:
    """Bytes that are, or will be, on the wire: from `begin` to `end`."""

    begin: float
    end: float
    data: bytes


class SimulatedLine:
    """The far end of a line with devices. `devices` may be changed and reached into at any time."""

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
        self.devices = list(devices)
        self.collisions = 0
        """Times that two spoke at once."""
        self._codec = codec
        self._loop = loop
        self._now = clock_of(loop)
        self.baudrate = baudrate
        self._byte_time = 10.0 / baudrate
        self._four_wires = four_wires
        """Questions and answers do not meet; two answers still do."""
        self._deliver: Callable[[bytes], None] = _nobody
        self._said_until = 0.0
        """When the master will have said all it was given to say."""
        self._sayings: list[Saying] = []
        """By end; no two overlap."""
        self._timer = FineTimer(loop, self._on_time) if wire_time else None
        self._closed = False

    def backlog(self) -> float:
        """Seconds until everything the master gave it is said."""
        return max(0.0, self._said_until - self._now())

    def attach(self, deliver: Callable[[bytes], None]) -> None:
        self._deliver = deliver

    def set_baudrate(self, baudrate: int) -> None:
        """What was on its way at another rate is understood by nobody."""
        if baudrate != self.baudrate:
            self.baudrate = baudrate
            self._byte_time = 10.0 / baudrate
            self._codec.reset()
            self._sayings.clear()

    def receive(self, data: bytes) -> None:
        if self._closed:
            return
        if self._timer is None:
            self._hear_at_once(data)
        else:
            self._hear(data, self._timer)

    def close(self) -> None:
        """Fall silent for good."""
        self._closed = True
        self._sayings.clear()
        if self._timer is not None:
            self._timer.close()

    # Without wire time

    def _hear_at_once(self, data: bytes) -> None:
        now = self._now()
        self._codec.receive_data(data)
        while (packet := self._codec.next_reply()) is not None:
            replies = self._ask(packet, now)
            if len(replies) == 1:
                self._say_soon(replies[0])
            else:
                for together in _slots(replies):
                    self._say_soon(self._in_one_slot(together))

    def _in_one_slot(self, replies: Sequence[DeviceReply]) -> DeviceReply:
        """One answer of several that speak at once."""
        self.collisions += len(replies) - 1
        said = replies[0].data
        for other in replies[1:]:
            said = blend(said, other.data, 0)
        return DeviceReply(said, late=max(reply.late for reply in replies))

    def _say_soon(self, reply: DeviceReply) -> None:
        if reply.late > 0:
            self._loop.call_later(reply.late, self._say, reply.data)
        else:
            self._loop.call_soon(self._say, reply.data)

    def _say(self, data: bytes) -> None:
        if not self._closed:
            self._deliver(data)

    # With wire time

    def _hear(self, data: bytes, timer: FineTimer) -> None:
        """The bytes go out behind what is still being said, one byte time each."""
        begin = max(self._now(), self._said_until)
        self._said_until = end = begin + len(data) * self._byte_time
        master = Saying(begin, end, data)
        self._clash(master)
        self._codec.receive_data(master.data)
        while (packet := self._codec.next_reply()) is not None:
            pending = min(len(data), self._codec.pending)
            said_at = end - pending * self._byte_time
            self._answer(packet, said_at)
            if self._clash(Saying(said_at, end, data[len(data) - pending :])):
                self._codec.reset()  # the master did not wait for the answer: nobody understands the rest
        if self._sayings:
            timer.arm(self._sayings[0].end)

    def _answer(self, packet: object, said_at: float) -> None:
        free = said_at
        for together in _slots(self._ask(packet, said_at)):
            floor = free
            for reply in together:
                begin = max(floor, said_at + reply.delay + reply.late)
                end = begin + len(reply.data) * self._byte_time
                free = max(free, end)
                self._put(Saying(begin, end, reply.data))

    def _put(self, saying: Saying) -> None:
        """On the wire it is one with whatever is there at the same time."""
        for other in [other for other in self._sayings if self._meet(other, saying)]:
            self.collisions += 1
            self._sayings.remove(other)
            saying = self._blend(other, saying)
        insort(self._sayings, saying, key=_end)

    def _clash(self, master: Saying) -> bool:
        """Whether the master speaks over replies: they are garbled, and so is what the devices hear of it."""
        met = [saying for saying in self._sayings if not self._four_wires and self._meet(saying, master)]
        for saying in met:
            shift = round((saying.begin - master.begin) / self._byte_time)
            master.data, saying.data = over(master.data, saying.data, shift), over(saying.data, master.data, -shift)
        self.collisions += len(met)
        return bool(met)

    def _meet(self, one: Saying, other: Saying) -> bool:
        """More than a touch of half a byte."""
        slack = self._byte_time / 2
        return one.begin < other.end - slack and other.begin < one.end - slack

    def _blend(self, one: Saying, other: Saying) -> Saying:
        first, second = sorted((one, other), key=_begin)
        shift = round((second.begin - first.begin) / self._byte_time)
        return Saying(first.begin, max(one.end, other.end), blend(first.data, second.data, shift))

    def _on_time(self) -> None:
        """Deliver what has been said by now."""
        now = self._now()
        while self._sayings and self._sayings[0].end <= now:
            self._deliver(self._sayings.pop(0).data)
        if self._sayings and self._timer:
            self._timer.arm(self._sayings[0].end)

    def _ask(self, packet: object, now: float) -> list[DeviceReply]:
        near = TOLERANCE * self.baudrate
        replies: list[DeviceReply] = []
        for device in self.devices:
            if abs(device.baudrate - self.baudrate) <= near:
                replies += device.handle(packet, now)
        return replies


def over(data: bytes, other: bytes, shift: int) -> bytes:
    """What is heard of `data` where `other`, that begins `shift` bytes later, is on the same wire."""
    return bytes(byte & other[at - shift] if 0 <= at - shift < len(other) else byte for at, byte in enumerate(data))


def blend(first: bytes, second: bytes, shift: int) -> bytes:
    """All that is heard of both; the second begins `shift` bytes later. A silent line is all ones."""
    return over(first.ljust(shift + len(second), b"\xff"), second, shift)


def _slots(replies: Iterable[DeviceReply]) -> list[list[DeviceReply]]:
    """In the order they speak; those of one slot speak at once."""
    return [list(together) for _, together in groupby(sorted(replies, key=_slot), key=_slot)]


def _nobody(data: bytes) -> None:
    """Takes what is said while nobody is attached."""
