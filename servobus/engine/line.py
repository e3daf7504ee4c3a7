"""When the line may be spoken on. Pure: told what was said and heard, and when.

After opening, after a missing answer and after anything unexpected the line is listened out until it was quiet for a
while. What was handed to the UART cannot be recalled, so at most one frame may wait in it behind the one that is
leaving.
"""

from __future__ import annotations

from servobus.protocols.base import LineTraits

QUIET = 0.002
"""Seconds without a byte after which the line counts as quiet."""
START_QUIET = 0.020
"""After opening: a servo may still be answering somebody else, or hold half a frame."""
HALF_AGAIN = 1.0
"""Seconds of half duplex after a missing answer."""
BABBLE = 0.250
"""Seconds of uninterrupted talk after which it is no late reply any more."""
ECHO_LIMIT = 4096
"""Bytes of our own that may be waited for."""


class EchoFilter:
    """Takes our own bytes out of what is heard, on a line that is known to echo."""

    __slots__ = ("_expected", "collisions")

    def __init__(self) -> None:
        self._expected = b""
        self.collisions = 0
        """Times something else was heard where our own bytes were due."""

    def sent(self, frame: bytes) -> None:
        if len(self._expected) + len(frame) > ECHO_LIMIT:  # the line does not echo at all
            self.collisions += 1
            self._expected = b""
        self._expected += frame

    def strip(self, data: bytes) -> bytes:
        """What is left of `data` when our own bytes are taken out."""
        if not self._expected:
            return data
        length = min(len(data), len(self._expected))
        if data[:length] != self._expected[:length]:
            self.collisions += 1
            self._expected = b""
            return data
        self._expected = self._expected[length:]
        return data[length:]

    def reset(self) -> None:
        self._expected = b""


class Line:
    """The state of one half-duplex line as its master knows it."""

    __slots__ = (
        "_last_start",
        "_listening_since",
        "_quiet_at",
        "babbling",
        "drains",
        "echo",
        "half_until",
        "sent_by",
        "spread",
        "traits",
    )

    def __init__(self, traits: LineTraits) -> None:
        self.traits = traits
        self.echo: EchoFilter | None = None
        self.spread: float | None = None
        """On four wires: seconds by which the pauses before two servos' answers may differ. None: half duplex."""
        self.half_until = 0.0
        """Half duplex all the same, after an answer was missing."""
        self.babbling = False
        """It has talked without a pause for too long, and has not been quiet since; only an e-stop is still said."""
        self.drains = 0
        self.sent_by = 0.0
        """When everything handed to the UART has left it."""
        self._last_start = 0.0
        """When the last frame began to leave: until then no other is handed over."""
        self._quiet_at = 0.0
        """Until then nothing is said."""
        self._listening_since: float | None = None

    def opened(self, now: float) -> None:
        self.sent_by = self._last_start = now
        self._listening_since = None
        self._quiet_at = 0.0
        self.babbling = False
        self.listen_out(now, START_QUIET)

    def listen_out(self, now: float, quiet: float = QUIET) -> None:
        """Something was heard or missed that was not expected: wait for silence from here. A longer silence that is due already
        is not cut short."""
        if self._listening_since is None:
            self._listening_since = now
            self.drains += 1
        self._quiet_at = max(self._quiet_at, now + max(quiet, self.traits.gap, self.traits.latency, 2 * self.traits.byte_time))

    @property
    def listening_out(self) -> bool:
        return self._listening_since is not None

    def ready_at(self, now: float, *, urgent: bool) -> float:
        """When the next frame may be handed over; not after `now`: at once."""
        if now >= self._quiet_at:
            if self._listening_since is not None:
                self.babbling = False
            return self._last_start
        if self._listening_since is not None:
            self.babbling = self.babbling or now - self._listening_since > BABBLE
        if self.babbling and urgent:  # an e-stop is not held back by a node that never stops talking
            return self._last_start
        return max(self._quiet_at, self._last_start)

    def next_at(self, size: int, now: float) -> float | None:
        """When a frame may be handed over behind one whose answer is due, so that the answers (of `size` bytes) cannot meet.
        Where all servos pause alike, the UART keeps frames apart: one may wait in it. None: not before that answer is here."""
        if self.spread is None or now < self.half_until or self._listening_since is not None:
            return None
        apart = size * self.traits.byte_time + self.spread if self.spread else 0.0
        return max(self._quiet_at, self._last_start + apart)

    def quiet(self) -> None:
        """It was listened out, and is about to be spoken on."""
        self._listening_since = None
        if self.echo is not None:
            self.echo.reset()

    def speak(self, frame: bytes, now: float, quiet_after: float) -> float:
        """A frame is handed over; when its first byte leaves. Where silence must go before the next, none is queued behind it."""
        start = max(now, self.sent_by)
        self._last_start = start
        self.sent_by = start + len(frame) * self.traits.byte_time
        silence = max(quiet_after, self.traits.gap)
        self._quiet_at = self.sent_by + silence if silence else 0.0
        if self.echo is not None:
            self.echo.sent(frame)
        return start

    def answered(self, now: float, quiet_after: float) -> None:
        """The answer is here, so all that was said has left, however soon that was (a PTY has no wire). Then the silence that
        must follow."""
        if self.sent_by > now:
            self.sent_by = self._last_start = now
        silence = max(quiet_after, self.traits.gap)
        if silence:
            self._quiet_at = now + silence
