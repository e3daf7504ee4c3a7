"""Errors: immutable, told apart by class, and copied with their place."""

from __future__ import annotations

import copy
import pickle

import pytest

from servobus.errors import DeviceError, LimitError, NotEnabled, PartialFailure, ReplyTimeout, ServobusError


@pytest.mark.parametrize("name", ["message", "bus", "servo", "request", "raw", "anything"])
def test_no_attribute_of_an_error_can_be_set(name: str) -> None:
    error = LimitError("too far", bus="arm")
    with pytest.raises(AttributeError, match="immutable"):
        setattr(error, name, "leg")
    with pytest.raises(AttributeError, match="immutable"):
        delattr(error, name)
    assert str(error) == "arm: too far"


def test_at_makes_a_new_error() -> None:
    error = DeviceError("overload", code=32, servo="elbow", raw=b"\x20")
    located = error.at(bus="arm", servo="wrist")
    assert (error.bus, located.bus, located.servo) == (None, "arm", "elbow"), "what is known stays"
    assert (type(located), located.code, located.raw) == (DeviceError, 32, b"\x20")
    assert str(located) == "arm/elbow: overload"


def test_a_new_error_keeps_cause_notes_and_traceback() -> None:
    try:
        try:
            raise ValueError("first")
        except ValueError as cause:
            raise ReplyTimeout("no reply") from cause
    except ReplyTimeout as caught:
        caught.add_note("a note")
        error, located = caught, caught.at(bus="arm")
    assert located.__cause__ is error.__cause__ is not None
    assert located.__traceback__ is error.__traceback__ is not None
    assert located.__suppress_context__
    located.add_note("another")
    assert error.__notes__ == ["a note"], "each error has its own notes"


def test_python_itself_may_raise_an_error_again() -> None:
    with pytest.raises(LimitError) as caught:
        raise LimitError("too far") from OSError(5, "broken")
    assert isinstance(caught.value.__cause__, OSError)


@pytest.mark.parametrize(
    "error",
    [DeviceError("overload", code=32, bus="arm"), PartialFailure({"a": LimitError("too far"), "b": "acked"}, bus="arm")],
)
@pytest.mark.parametrize("way", [copy.copy, lambda error: pickle.loads(pickle.dumps(error)), lambda error: error.at()])
def test_an_error_survives_copy_and_pickle(error: ServobusError, way: object) -> None:
    assert callable(way)
    twin = way(error)
    assert (type(twin), str(twin), vars(twin).keys()) == (type(error), str(error), vars(error).keys())
    assert twin.bus == "arm"


def test_a_partial_failure_names_each_cause_once() -> None:
    causes = {"a": NotEnabled("enable it first", servo="a"), "b": NotEnabled("enable it first"), "c": LimitError("too far")}
    error = PartialFailure({"a": causes["a"], "d": "acked", "b": causes["b"], "c": causes["c"]})
    assert str(error) == "3 of 4 failed: a, b: enable it first; c: too far"
    assert error.results["b"] is causes["b"]
