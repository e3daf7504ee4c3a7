"""The printer of frames: a line delivers frames in pieces, and it prints each frame once."""

from __future__ import annotations

import pytest

from servobus.cli.frames import STALE_S, Tracer
from servobus.protocols.sms.codec import SmsCodec

PING = bytes.fromhex("FFFF010201FB")
OK = bytes.fromhex("FFFF010200FC")
TWO = bytes.fromhex("FFFF020200FB")


class TracerLines:
    """A tracer of one bus, and the lines that it printed."""

    def __init__(self, *, replies: bool = True) -> None:
        self.lines: list[str] = []
        self.trace = Tracer({"arm": SmsCodec()}, self.lines.append, replies=replies)

    def receive(self, data: bytes, now: float = 0.0) -> None:
        self.trace("arm", False, data, now)

    def send(self, data: bytes, now: float = 0.0) -> None:
        self.trace("arm", True, data, now)

    @property
    def described(self) -> list[str]:
        return [line.split(None, 1)[1] for line in self.lines]


OK_LINE = "arm < ff ff 01 02 00 fc   id 1 ok"


@pytest.mark.parametrize("size", range(1, 7))
def test_a_frame_in_pieces_is_one_line(size: int) -> None:
    tracer = TracerLines()
    for start in range(0, len(OK), size):
        tracer.receive(OK[start : start + size])
    assert tracer.described == [OK_LINE]


def test_frames_and_the_noise_between_them() -> None:
    tracer = TracerLines()
    tracer.receive(b"\x00" + OK + b"\x07\x08" + TWO + b"\x09")
    assert tracer.described == [
        "arm < 00   no SMS packet: 00",
        OK_LINE,
        "arm < 07 08   no SMS packet: 07 08",
        "arm < ff ff 02 02 00 fb   id 2 ok",
        "arm < 09   no SMS packet: 09",
    ]


def test_times_count_from_the_first_frame() -> None:
    tracer = TracerLines()
    tracer.send(PING, 100.0)
    tracer.receive(OK, 100.25)
    assert tracer.lines == ["   0.0000 arm > ff ff 01 02 01 fb   id 1 PING", "   0.2500 " + OK_LINE]


@pytest.mark.parametrize(("pause", "given_up"), [(STALE_S, True), (STALE_S / 2, False)])
def test_an_old_part_of_a_frame_is_given_up(pause: float, given_up: bool) -> None:
    tracer = TracerLines()
    tracer.receive(OK[:4])
    tracer.send(PING, pause)
    tracer.receive(OK[4:], pause)
    half = "arm < ff ff 01 02   no SMS packet: ff ff 01 02"
    sent = "arm > ff ff 01 02 01 fb   id 1 PING"
    assert tracer.described == ([half, sent, "arm < 00 fc   no SMS packet: 00 fc"] if given_up else [sent, OK_LINE])


def test_an_unfinished_frame_is_printed_at_the_end() -> None:
    tracer = TracerLines()
    tracer.receive(OK[:3])
    assert tracer.described == []
    tracer.trace.close()
    tracer.trace.close()
    assert tracer.described == ["arm < ff ff 01   no SMS packet: ff ff 01"]


def test_a_dry_run_prints_requests_alone() -> None:
    tracer = TracerLines(replies=False)
    tracer.send(PING)
    tracer.receive(OK)
    tracer.trace.close()
    assert tracer.described == ["arm > ff ff 01 02 01 fb   id 1 PING"]
