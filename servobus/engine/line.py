"""When a frame may be transmitted. Pure: the line is told what was sent and received, and when.

After the port was opened, after a missing reply and after anything unexpected, the master transmits nothing until the
line was silent for a while. A frame that the UART has taken cannot be recalled, so at most one frame may wait in it
behind the one that is leaving.
"""

from __future__ import annotations

from servobus.protocols.base import LineTraits

QUIET = 0.002
"""Seconds without a byte after which the line counts as silent."""
START_QUIET = 0.020
"""The same after opening: a servo may still be answering another master, or hold half a frame."""
BABBLE = 0.250
"""Seconds without silence after which what arrives is no late reply any more."""
MAX_GREETING = 64
"""Bytes of a greeting that are kept."""
ECHO_LIMIT = 4096
"""Bytes of our own whose echo may be outstanding."""


class EchoFilter:
    """Removes our own bytes from what is received, on a line that is known to echo."""

    __slots__ = ("_expected", "collisions")

    def __init__(self) -> None:
        self._expected = b""
        self.collisions = 0
        """Times that other bytes arrived where our own were due."""

    def sent(self, frame: bytes) -> None:
        if len(self._expected) + len(frame) > ECHO_LIMIT:  # the line does not echo at all
            self.collisions += 1
            self._expected = b""
        self._expected += frame

    def strip(self, data: bytes) -> bytes:
        """Return `data` without our own bytes."""
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
        "_opened_at",
        "_waiting_since",
        "babbling",
        "byte_time",
        "drains",
        "echo",
        "gap",
        "greeting",
        "last_start",
        "paced",
        "quiet_until",
        "sent_by",
        "traits",
        "waiting_for_silence",
    )

    traits: LineTraits

    def __init__(self, traits: LineTraits) -> None:
        self.use(traits)
        self.echo: EchoFilter | None = None
        self.babbling = False
        """Bytes arrived without a pause for too long, and the line was not silent since. Only an e-stop is transmitted."""
        self.drains = 0
        """Times that it had to fall silent before the next frame."""
        self.sent_by = 0.0
        """When everything handed to the UART has left it."""
        self.last_start = 0.0
        """When the last frame begins to leave: until then no other is handed over."""
        self.quiet_until = 0.0
        """Until then nothing is transmitted."""
        self.waiting_for_silence = False
        self.greeting = b""
        """The first bytes that arrived since it was opened, before anything was sent."""
        self._opened_at = 0.0
        self._waiting_since = 0.0

    def use(self, traits: LineTraits) -> None:
        """Take over what the link knows of its line."""
        self.traits = traits
        self.byte_time = traits.byte_time
        self.gap = traits.gap
        self.paced = traits.paced

    def opened(self, now: float) -> None:
        self.sent_by = self.last_start = self._opened_at = now
        self.greeting = b""
        self.waiting_for_silence = False
        self.quiet_until = 0.0
        self.babbling = False
        self.wait_for_silence(now, START_QUIET)

    def greeted(self, data: bytes) -> None:
        """Keep bytes that arrived unasked, if nothing was sent yet: they tell what is at the other end."""
        if self.sent_by <= self._opened_at:
            self.greeting = (self.greeting + data)[:MAX_GREETING]

    def wait_for_silence(self, now: float, quiet: float = QUIET) -> None:
        """Transmit nothing until `quiet` seconds passed without a byte. A longer silence that is due already is kept."""
        if not self.waiting_for_silence:
            self.waiting_for_silence = True
            self._waiting_since = now
            self.drains += 1
        self.quiet_until = max(self.quiet_until, now + max(quiet, self.gap, self.traits.latency, 2 * self.byte_time))

    def is_ready(self, now: float) -> bool:
        """Return whether a frame may be handed over now and no silence had to be waited for: nearly always."""
        return now >= self.quiet_until and now >= self.last_start and not self.waiting_for_silence

    def ready_at(self, now: float, *, estop_pending: bool) -> float:
        """Return when the next frame may be handed over. A time that is not after `now` means at once."""
        if now >= self.quiet_until:
            if self.waiting_for_silence:
                self.babbling = False
            return self.last_start
        if self.waiting_for_silence:
            self.babbling = self.babbling or now - self._waiting_since > BABBLE
        if self.babbling and estop_pending:  # a node that never stops sending does not hold back an e-stop
            return self.last_start
        return max(self.quiet_until, self.last_start)

    def end_wait(self) -> None:
        """Note that the silence has passed and a frame follows."""
        self.waiting_for_silence = False
        if self.echo is not None:
            self.echo.reset()

    def send(self, frame: bytes, now: float, quiet_after: float) -> float:
        """Note a frame that is handed over; return when its first byte leaves. Where a silence must follow it, no other frame is
        queued behind it."""
        start = now if now > self.sent_by else self.sent_by
        self.last_start = start
        self.sent_by = start + len(frame) * self.byte_time
        silence = quiet_after if quiet_after > self.gap else self.gap
        self.quiet_until = self.sent_by + silence if silence else 0.0
        if self.echo is not None:
            self.echo.sent(frame)
        return start

    def answered(self, now: float, quiet_after: float) -> None:
        """Note that the replies are complete: everything sent has left, even if that was sooner than its wire time (a PTY has
        none). The silence that must follow begins."""
        if self.sent_by > now:
            self.sent_by = self.last_start = now
        silence = quiet_after if quiet_after > self.gap else self.gap
        if silence:
            self.quiet_until = now + silence
