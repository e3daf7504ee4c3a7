"""The printer behind `--trace` and `--dry-run`: each frame on the wire as a line of bytes and of words."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

from servobus.protocols.base import Codec

STALE_S = 0.005
"""Age in seconds at which a part of a frame is given up when the next request leaves: the rest does not come any more."""


class FrameSplitter:
    """Cuts the bytes received on one bus into frames."""

    def __init__(self, codec: Codec) -> None:
        self.codec = codec
        self._buffer = b""
        self._last = 0.0

    def receive(self, data: bytes, now: float) -> Iterator[bytes]:
        """Yields each frame that is complete, and the bytes between frames that are not a frame."""
        self._last = now
        self._buffer += data
        self.codec.receive_data(data)
        while (reply := self.codec.next_reply()) is not None:
            before, _, self._buffer = self._buffer.partition(reply.frame)
            if before:
                yield before
            yield reply.frame
        noise = len(self._buffer) - self.codec.pending
        if noise > 0:
            yield self._buffer[:noise]
            self._buffer = self._buffer[noise:]

    def flush(self, now: float = float("inf")) -> bytes:
        """Returns the part of a frame that was never completed; empty while the rest may still come."""
        if not self._buffer or now - self._last < STALE_S:
            return b""
        part, self._buffer = self._buffer, b""
        self.codec.reset()
        return part


class Tracer:
    """Prints a line for each frame; `LocalRig` calls it with all bytes on the wire.

    Args:
        codecs: Bus -> a codec of its own.
        write_line: Takes each line.
        replies: False prints requests alone.
    """

    def __init__(self, codecs: Mapping[str, Codec], write_line: Callable[[str], None], *, replies: bool) -> None:
        self._splitters = {bus: FrameSplitter(codec) for bus, codec in codecs.items()}
        self._write_line = write_line
        self._replies = replies
        self._start: float | None = None
        self._elapsed = 0.0

    def __call__(self, bus: str, sent: bool, data: bytes, now: float) -> None:
        if self._start is None:
            self._start = now
        self._elapsed = now - self._start
        splitter = self._splitters[bus]
        if sent:
            self._print(bus, splitter.flush(now))
            self._print(bus, data, sent=True)
        elif self._replies:
            for frame in splitter.receive(data, now):
                self._print(bus, frame)

    def close(self) -> None:
        """Print the parts of frames that were never completed."""
        for bus, splitter in self._splitters.items():
            self._print(bus, splitter.flush())

    def _print(self, bus: str, frame: bytes, *, sent: bool = False) -> None:
        if frame:
            description = self._splitters[bus].codec.describe(frame, sent=sent)
            self._write_line(f"{self._elapsed:9.4f} {bus} {'>' if sent else '<'} {frame.hex(' ')}   {description}")
