"""Frames out of the pieces in which a line delivers them."""

from __future__ import annotations

import pytest

from servobus.cli.frames import STALE, Tracer
from servobus.protocols.sms.codec import SmsCodec

PING = bytes.fromhex("FFFF010201FB")
OK = bytes.fromhex("FFFF010200FC")
TWO = bytes.fromhex("FFFF020200FB")


class Told:
    """A tracer of one bus, and its lines without their times."""

    def __init__(self, *, heard: bool = True) -> None:
        self.lines: list[str] = []
        self.trace = Tracer({"arm": SmsCodec()}, self.lines.append, heard=heard)

    def hear(self, data: bytes, now: float = 0.0) -> None:
        self.trace("arm", False, data, now)

    def say(self, data: bytes, now: float = 0.0) -> None:
        self.trace("arm", True, data, now)

    @property
    def words(self) -> list[str]:
        return [line.split(None, 1)[1] for line in self.lines]


OK_LINE = "arm < ff ff 01 02 00 fc   id 1 ok"


@pytest.mark.parametrize("size", range(1, 7))
def test_a_frame_in_pieces_is_one_line(size: int) -> None:
    told = Told()
    for start in range(0, len(OK), size):
        told.hear(OK[start : start + size])
    assert told.words == [OK_LINE]


def test_several_frames_in_one_piece_and_what_stands_between_them() -> None:
    told = Told()
    told.hear(b"\x00" + OK + b"\x07\x08" + TWO + b"\x09")
    assert told.words == [
        "arm < 00   no SMS packet: 00",
        OK_LINE,
        "arm < 07 08   no SMS packet: 07 08",
        "arm < ff ff 02 02 00 fb   id 2 ok",
        "arm < 09   no SMS packet: 09",
    ]


def test_times_count_from_the_first_frame() -> None:
    told = Told()
    told.say(PING, 100.0)
    told.hear(OK, 100.25)
    assert told.lines == ["   0.0000 arm > ff ff 01 02 01 fb   id 1 PING", "   0.2500 " + OK_LINE]


@pytest.mark.parametrize(("pause", "given_up"), [(STALE, True), (STALE / 2, False)])
def test_half_a_frame_is_given_up_once_it_is_old(pause: float, given_up: bool) -> None:
    told = Told()
    told.hear(OK[:4])
    told.say(PING, pause)
    told.hear(OK[4:], pause)
    half = "arm < ff ff 01 02   no SMS packet: ff ff 01 02"
    said = "arm > ff ff 01 02 01 fb   id 1 PING"
    assert told.words == ([half, said, "arm < 00 fc   no SMS packet: 00 fc"] if given_up else [said, OK_LINE])


def test_what_was_never_finished_is_told_at_the_end() -> None:
    told = Told()
    told.hear(OK[:3])
    assert told.words == []
    told.trace.close()
    told.trace.close()
    assert told.words == ["arm < ff ff 01   no SMS packet: ff ff 01"]


def test_a_dry_run_tells_only_what_is_sent() -> None:
    told = Told(heard=False)
    told.say(PING)
    told.hear(OK)
    told.trace.close()
    assert told.words == ["arm > ff ff 01 02 01 fb   id 1 PING"]
