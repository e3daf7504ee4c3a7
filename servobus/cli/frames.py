"""`--trace` and `--dry-run`: what is on the wire, frame by frame and in words."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

from servobus.protocols.base import Codec

STALE = 0.005
"""Seconds after which a piece of a frame is given up when something is said: its rest does not come any more."""


class Ear:
    """What is heard on one bus comes in pieces; what people read are frames."""

    def __init__(self, codec: Codec) -> None:
        self.codec = codec
        self._heard = b""
        self._last = 0.0

    def hear(self, data: bytes, now: float) -> Iterator[bytes]:
        """The frames that are whole now, and between them what was none."""
        self._last = now
        self._heard += data
        self.codec.receive_data(data)
        while (reply := self.codec.next_reply()) is not None:
            before, _, self._heard = self._heard.partition(reply.frame)
            if before:
                yield before
            yield reply.frame
        noise = len(self._heard) - self.codec.pending
        if noise > 0:
            yield self._heard[:noise]
            self._heard = self._heard[noise:]

    def rest(self, now: float = float("inf")) -> bytes:
        """A piece of a frame whose rest did not come."""
        if not self._heard or now - self._last < STALE:
            return b""
        rest, self._heard = self._heard, b""
        self.codec.reset()
        return rest


class Tracer:
    """Called with everything on the wire; `say` is told a line for each frame. `heard=False`: only what is sent."""

    def __init__(self, codecs: Mapping[str, Codec], say: Callable[[str], None], *, heard: bool) -> None:
        self._ears = {bus: Ear(codec) for bus, codec in codecs.items()}
        self._say = say
        self._heard = heard
        self._began: float | None = None
        self._now = 0.0

    def __call__(self, bus: str, sent: bool, data: bytes, now: float) -> None:
        if self._began is None:
            self._began = now
        self._now = now - self._began
        ear = self._ears[bus]
        if sent:
            self._tell(bus, ear.rest(now))
            self._tell(bus, data, sent=True)
        elif self._heard:
            for frame in ear.hear(data, now):
                self._tell(bus, frame)

    def close(self) -> None:
        """Tell what was never finished."""
        for bus, ear in self._ears.items():
            self._tell(bus, ear.rest())

    def _tell(self, bus: str, frame: bytes, *, sent: bool = False) -> None:
        if frame:
            words = self._ears[bus].codec.describe(frame, sent=sent)
            self._say(f"{self._now:9.4f} {bus} {'>' if sent else '<'} {frame.hex(' ')}   {words}")
