"""Why a request has no value: each cause has its own text, and is counted for its node."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from servobus.engine.stats import Cause
from servobus.errors import DeviceError, ReplyTimeout
from servobus.values import Health
from tests.engine.driven_engine import Rig
from tests.engine.toy_protocol import ANSWER, PING, READ, REFUSED, ToyReply, ToyRequest, poll, read, reply, write

ARRIVALS = {
    Cause.SILENT: [],
    Cause.GARBLED: [b"\x00\x13\x37\x00\x42\x99"],
    Cause.FOREIGN: [reply(3, READ, 7).frame],
    Cause.LATE: [reply(1, PING | ANSWER, 9).frame],
}
TEXTS = {
    Cause.SILENT: "no answer",
    Cause.GARBLED: "garbled replies",
    Cause.FOREIGN: "other nodes",
    Cause.LATE: "late reply",
}


@pytest.mark.parametrize("cause", ARRIVALS)
def test_a_timeout_names_what_arrived_instead(cause: Cause) -> None:
    rig = Rig()
    results = rig.submit(read(1, 5), tries=1)
    rig.hear(*ARRIVALS[cause])
    assert isinstance(results[0], ReplyTimeout)
    assert TEXTS[cause] in str(results[0])
    assert rig.node(1).causes[cause] >= 1
    assert [text for other, text in TEXTS.items() if other is not cause and text in str(results[0])] == []


def test_only_what_asks_to_change_something_may_have_been_applied() -> None:
    rig = Rig()
    asked, changed = rig.submit(read(1, 5), tries=1), rig.submit(write(2, 5, changes=True), tries=1)
    for _ in range(6):
        if rig.transmit() is not None:
            rig.now += 1.0
            rig.engine.timed_out(rig.now)
    assert "applied" not in str(asked[0])
    assert "may have been applied" in str(changed[0])


class Relayed(ToyRequest):
    """A gateway answers that it has no answer (99)."""

    relayed = True

    def is_silence(self, replies: Sequence[Any]) -> bool:
        return bool(replies[0].payload[1] == 99)


def test_a_gateway_that_has_no_answer_counts_as_silence() -> None:
    rig = Rig()
    results = rig.submit(Relayed(1, READ, 5), tries=1)
    rig.hear(reply(1, READ, 99).frame)
    assert results == [99], "what it means to the caller is said by the request"
    assert rig.node(1).health is Health.DOUBTFUL
    assert rig.node(1).causes[Cause.NO_ANSWER] == 1
    assert rig.node(1).misses == 1, "it may be offline: it was not the node that answered"


class Unanswered(Relayed):
    """What the gateway says is no reply to it either."""

    def answers(self, reply: ToyReply) -> bool:
        return super().answers(reply) and not self.is_silence((reply,))


def test_what_a_gateway_says_of_a_silent_node_is_no_late_reply_of_it() -> None:
    rig = Rig()
    results = rig.submit(Unanswered(1, READ, 5), tries=1)
    rig.hear(reply(1, READ, 99).frame)
    assert "the gateway reports no answer after 1 try" in str(results[0])
    assert (rig.node(1).causes[Cause.NO_ANSWER], rig.node(1).causes[Cause.LATE]) == (1, 0)


def test_refusals_are_counted_and_polls_that_are_refused_make_it_fail() -> None:
    rig = Rig()
    rig.scheduler.set_polls([poll("health", 10, 1)], rig.now)
    for _ in range(4):
        rig.answer(REFUSED)
        rig.now += 0.1
    assert rig.node(1).causes[Cause.REFUSED] == 4
    assert rig.node(1).failing == "it says no"
    assert all(isinstance(update, DeviceError) for update in rig.updates)
    rig.answer(1)
    assert rig.node(1).failing == ""
