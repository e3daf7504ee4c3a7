"""The byte buffer that every codec shares: receives bytes in any pieces, cuts frames out, and counts what it skips."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Generic, TypeVar

from servobus.protocols.base import Reply

F = TypeVar("F", bound=Reply)


class StreamCodec(ABC, Generic[F]):
    """The base of a codec. A subclass decides in `next_reply` where a frame begins and ends.

    `next_reply` cuts the frame out with `cut`, or skips the bytes that cannot begin a frame and returns None. What it keeps must
    be shorter than the longest frame, so that the memory is bounded.
    """

    __slots__ = ("buffer", "skipped")

    def __init__(self) -> None:
        self.buffer = b""
        """Bytes received that are not decoded yet."""
        self.skipped = 0
        """Bytes skipped since the beginning because they belong to no frame."""

    @property
    def pending(self) -> int:
        """Bytes received that are no frame yet."""
        return len(self.buffer)

    def receive_data(self, data: bytes) -> None:
        """Append received bytes."""
        self.buffer = self.buffer + data if self.buffer else bytes(data)

    @abstractmethod
    def next_reply(self) -> F | None:
        """Return the next whole valid frame; None: more bytes are needed."""

    def reset(self) -> None:
        """Forget the received bytes."""
        self.buffer = b""

    def skip(self, count: int) -> None:
        """Drop the first bytes and count them as skipped."""
        if count:
            self.skipped += count
            self.buffer = self.buffer[count:]

    def skip_to_header(self, header: bytes, start: int) -> None:
        """Skip everything from `start` on, because no header follows; keep a beginning of one at the end."""
        rest = len(self.buffer) - start
        part = next((size for size in range(min(len(header) - 1, rest), 0, -1) if self.buffer.endswith(header[:size])), 0)
        self.skip(len(self.buffer) - part)

    def cut(self, start: int, end: int) -> bytes:
        """Return the frame between these places; skip what comes before it and keep what follows."""
        frame = self.buffer[start:end]
        self.skipped += start
        self.buffer = self.buffer[end:]
        return frame


def decode_single(codec: StreamCodec[F], frame: bytes) -> F | None:
    """Return the one frame that these bytes are, decoded by a fresh codec; None where they are anything else."""
    codec.receive_data(frame)
    reply = codec.next_reply()
    return reply if reply is not None and reply.frame == frame else None
