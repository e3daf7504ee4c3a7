"""The byte buffer that every codec shares."""

from __future__ import annotations

from typing import NamedTuple

import pytest

from servobus.protocols.stream import StreamCodec, decode_single

HEADER = b"\xfa\xfb\xfc"


class Text(NamedTuple):
    frame: bytes
    node: int = 0
    key: int = 0
    status: int | None = None


class TextCodec(StreamCodec[Text]):
    """A frame is the header and one byte."""

    __slots__ = ()

    def next_reply(self) -> Text | None:
        start = self.buffer.find(HEADER)
        if start < 0:
            self.skip_to_header(HEADER, 0)
            return None
        if len(self.buffer) < start + 4:
            self.skip(start)
            return None
        return Text(self.cut(start, start + 4))


def received(*pieces: bytes) -> TextCodec:
    codec = TextCodec()
    for piece in pieces:
        codec.receive_data(piece)
    return codec


def test_bytes_in_any_pieces_make_the_same_frames() -> None:
    for pieces in ([HEADER + b"1" + HEADER + b"2"], [b"\xfa", b"\xfb\xfc", b"1\xfa\xfb", b"\xfc2"]):
        codec = received(*pieces)
        frames = [codec.next_reply(), codec.next_reply(), codec.next_reply()]
        assert frames == [Text(HEADER + b"1"), Text(HEADER + b"2"), None]
        assert (codec.pending, codec.skipped) == (0, 0)


def test_bytes_before_a_frame_are_counted_as_skipped() -> None:
    codec = received(b"junk" + HEADER + b"1" + b"rest")
    assert codec.next_reply() == Text(HEADER + b"1")
    assert (codec.pending, codec.skipped) == (4, 4)


@pytest.mark.parametrize(
    ("data", "pending"), [(b"junk", 0), (b"junk\xfa", 1), (b"junk\xfa\xfb", 2), (b"\xfa\xfb\xfd", 0), (b"", 0), (b"\xfa\xfa", 1)]
)
def test_only_the_beginning_of_a_header_is_kept(data: bytes, pending: int) -> None:
    codec = received(data)
    assert codec.next_reply() is None
    assert (codec.pending, codec.skipped) == (pending, len(data) - pending)


def test_reset_forgets_the_bytes_and_keeps_the_count() -> None:
    codec = received(b"junk", HEADER)
    assert codec.next_reply() is None
    codec.reset()
    assert (codec.pending, codec.skipped) == (0, 4)


@pytest.mark.parametrize("data", [b"", HEADER, b"x" + HEADER + b"1", HEADER + b"12", HEADER + b"1" + HEADER + b"2"])
def test_a_single_frame_is_exactly_one_frame(data: bytes) -> None:
    assert decode_single(TextCodec(), data) is None
    assert decode_single(TextCodec(), HEADER + b"1") == Text(HEADER + b"1")
