"""The page of events and counters is the one that the enums give."""

from __future__ import annotations

from servobus.engine.stats import Counter
from servobus.values import EventName
from tests.docs.events_page import PATH, page


def test_the_page_is_up_to_date() -> None:
    assert PATH.read_text() == page(), "run scripts/docs"


def test_each_event_and_counter_has_one_sentence() -> None:
    for member in (*EventName, *Counter):
        assert member.description.endswith("."), member
        assert "|" not in member.description, member
