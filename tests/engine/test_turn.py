"""What is heard in a window."""

from __future__ import annotations

import pytest

from servobus.engine.job import Job
from servobus.engine.turn import Turn, Window, judge
from servobus.protocols.base import Reply
from tests.engine.toy_protocol import PING, READ, WRITE, Sink, ToyCodec, ToyRequest, encode, group_read, read, reply, write


class OneTurn:
    """A turn and the codec it listens with."""

    def __init__(self, request: ToyRequest) -> None:
        job = Job(Sink(), 1.0, request=request)
        self.turn = Turn(request.frame, 2.0, request, job, sent_at=1.0, sent_by=1.1)
        self.codec = ToyCodec()
        self.strays: list[Reply] = []

    def hear(self, *pieces: bytes) -> list[bool]:
        """Whether the turn is believed after each piece."""
        believed = []
        for piece in pieces:
            self.codec.receive_data(piece)
            window, strays = judge(self.codec, self.turn)
            self.strays += strays
            believed.append(window is Window.BELIEVED)
        return believed

    @property
    def values(self) -> list[tuple[int, int]]:
        return [(each.node, each.payload[1]) for each in self.turn.replies]


def answer(node: int, value: int) -> bytes:
    return reply(node, READ, value).frame


# Windows


def test_the_answer_is_taken_in_one_piece_and_byte_by_byte() -> None:
    whole, bitwise = OneTurn(read(1)), OneTurn(read(1))
    assert whole.hear(answer(1, 7)) == [True]
    assert bitwise.hear(*(bytes((each,)) for each in answer(1, 7))) == [False] * 5 + [True]
    assert whole.values == bitwise.values == [(1, 7)]


def test_bytes_before_the_answer_are_skipped() -> None:
    window = OneTurn(read(1))
    assert window.hear(b"\x00\xa5\x00", b"\x00" + answer(1, 7)) == [False, True]


@pytest.mark.parametrize("junk", [b"\x00", b"\xa5", bytes(9)])
def test_bytes_behind_the_answer_reject_the_window(junk: bytes) -> None:
    window = OneTurn(read(1))
    assert window.hear(answer(1, 7) + junk) == [False]
    assert window.turn.complete(), "nothing more is due: the master need not wait for the deadline"


@pytest.mark.parametrize(
    "stray",
    [
        pytest.param(answer(2, 9), id="another node"),
        pytest.param(reply(1, PING, 3).frame, id="another question"),
        pytest.param(encode(1, READ, 9), id="another request"),
    ],
)
def test_a_valid_frame_that_is_no_answer_is_a_stray_and_the_turn_goes_on(stray: bytes) -> None:
    window = OneTurn(read(1))
    assert window.hear(stray, answer(1, 7)) == [False, True]
    assert [each.frame for each in window.strays] == [stray]
    assert window.values == [(1, 7)]


def test_an_answer_that_comes_twice_is_taken_once() -> None:
    window = OneTurn(read(1))
    assert window.hear(answer(1, 7) + answer(1, 8)) == [True]
    assert window.values == [(1, 7)]
    assert [each.frame for each in window.strays] == [answer(1, 8)]


def test_a_frame_identical_to_the_request_is_an_echo_and_no_answer() -> None:
    window = OneTurn(write(1, 5))
    request = write(1, 5).frame
    assert window.hear(request, request) == [False, False]
    assert (window.turn.echoes, window.strays) == (2, [])
    assert window.hear(reply(1, WRITE, 5).frame) == [True]


def test_an_answer_behind_which_stands_junk_is_not_believed_although_a_frame_follows() -> None:
    window = OneTurn(read(1))
    assert window.hear(answer(1, 7) + b"\x00" + answer(1, 8)) == [False]
    assert window.values == []
    assert window.turn.missing() == [1]
    assert len(window.strays) == 1


# Several answers


def test_several_answers_come_in_any_order_and_pieces() -> None:
    window = OneTurn(group_read(1, 2, 3))
    stream = answer(3, 30) + answer(1, 10) + answer(2, 20)
    assert window.hear(stream[:8], stream[8:13], stream[13:]) == [False, False, True]
    assert window.values == [(3, 30), (1, 10), (2, 20)]
    assert window.turn.missing() == []


def test_who_answered_twice_does_not_stand_for_another() -> None:
    window = OneTurn(group_read(1, 2))
    assert window.hear(answer(1, 10) + answer(1, 11)) == [False]
    assert window.values == [(1, 10)]
    assert [each.node for each in window.strays] == [1]
    assert window.turn.missing() == [2]


@pytest.mark.parametrize("cut", [0, 6, 7, 10])
def test_junk_between_answers_takes_the_one_before_it_and_leaves_the_others(cut: int) -> None:
    window = OneTurn(group_read(1, 2, 3))
    stream = answer(1, 10) + b"\x00" + answer(2, 20) + answer(3, 30)
    window.hear(stream[:cut], stream[cut:])
    assert window.values == [(2, 20), (3, 30)]
    assert window.turn.missing() == [1]
    assert not window.turn.complete()
    assert window.hear(answer(1, 10)) == [False], "said once more it is a stray"


def test_junk_before_the_first_answer_of_several_is_skipped() -> None:
    window = OneTurn(group_read(1, 2))
    assert window.hear(b"\x00\x00" + answer(1, 10) + answer(2, 20)) == [True]


def test_any_one_may_answer_a_question_to_nobody_in_particular() -> None:
    request = ToyRequest(255, READ, 0, replies=1)
    request.answers = lambda reply: True  # type: ignore[method-assign]
    window = OneTurn(request)
    assert window.turn.missing() == []
    assert window.hear(answer(9, 1)) == [True]
