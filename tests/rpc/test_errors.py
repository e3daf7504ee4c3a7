"""Errors through a door: each comes out as what it was, and nothing a daemon sends makes anything but an exception of it."""

from __future__ import annotations

import json
from typing import Any

import pytest

from servobus.errors import DeviceError, GoalExpired, NotSupported, PartialFailure, ServobusError
from servobus.protocols.kst.aborts import AccessRefused, HardwareFault
from servobus.rpc.errors import FAILED, INTERNAL, INVALID_PARAMS, NO_METHOD, TYPES, decoded, encoded
from servobus.values import Outcome


def through(error: ServobusError) -> Exception:
    return decoded(json.loads(json.dumps(encoded(error))))


def test_every_class_can_be_sent() -> None:
    def kinds(kind: type[ServobusError]) -> set[type[ServobusError]]:
        return {kind}.union(*(kinds(child) for child in kind.__subclasses__()))

    assert set(TYPES.values()) == {kind for kind in kinds(ServobusError) if kind.__module__ == "servobus.errors"}


@pytest.mark.parametrize("kind", [kind for kind in TYPES.values() if kind is not PartialFailure])
def test_each_comes_out_as_it_was(kind: type[ServobusError]) -> None:
    error = through(kind("no: do so", bus="arm", servo="elbow", raw=b"\xff\x00"))
    assert type(error) is kind
    assert isinstance(error, ServobusError)
    assert (error.message, error.bus, error.servo, error.raw) == ("no: do so", "arm", "elbow", b"\xff\x00")
    assert str(error) == "arm/elbow: no: do so"
    assert error.exit_status == kind.exit_status
    bare = through(kind("no"))
    assert isinstance(bare, ServobusError)
    assert (str(bare), bare.bus, bare.servo, bare.raw) == ("no", None, None, b"")


@pytest.mark.parametrize("code", [0, 5, 0x06060000, None])
def test_the_code_of_a_device(code: int | None) -> None:
    error = through(DeviceError("overload", code=code))
    assert isinstance(error, DeviceError)
    assert error.code == code


def test_parts() -> None:
    results = {"arm/a": Outcome.ACKED, "arm/b": GoalExpired("late", servo="b"), "arm/c": ValueError("odd"), "arm/d": None}
    error = through(PartialFailure(results))
    assert isinstance(error, PartialFailure)
    assert str(error) == str(PartialFailure(results)).replace("odd", "the daemon could not do it: odd")
    assert error.results["arm/a"] is Outcome.ACKED
    assert type(error.results["arm/b"]) is GoalExpired
    assert isinstance(error.results["arm/c"], ServobusError)
    assert error.results["arm/d"] is None


def test_the_finer_kinds_of_a_protocol() -> None:
    fault = through(HardwareFault("hot", code=0x06060000))
    assert type(fault) is DeviceError
    assert fault.code == 0x06060000
    refused = through(AccessRefused("read only", code=0x06010002, servo="pan"))
    assert isinstance(refused, DeviceError)
    assert isinstance(refused, NotSupported)
    assert (refused.code, refused.servo, refused.exit_status) == (0x06010002, "pan", AccessRefused("").exit_status)


def test_what_is_wrong_with_the_call_itself() -> None:
    assert isinstance(decoded({"code": INVALID_PARAMS, "message": "no field x"}), TypeError)
    for code in (NO_METHOD, INTERNAL):
        error = decoded({"code": code, "message": "no such method"})
        assert type(error) is ServobusError
        assert "no such method" in str(error)


@pytest.mark.parametrize(
    "data",
    [
        None,
        1,
        [],
        {},
        {"type": None},
        {"type": "KeyboardInterrupt"},
        {"type": "object", "also": ["DeviceError", 3]},
        {"type": "DeviceError", "also": ["ServobusError", "DeviceError", "LinkDown", "PartialFailure"] * 9, "code": "x"},
        {"type": "ServobusError", "also": ["DeviceError"]},
        {"type": "PartialFailure"},
        {"type": "PartialFailure", "results": 1},
        {"type": "PartialFailure", "results": [1]},
        {"type": "PartialFailure", "results": {"a": 1, "b": {"error": 5}, "c": {"result": []}}},
        {"type": "DeviceError", "code": {}, "raw": "zz", "bus": 5, "servo": []},
        {"type": "LimitError", "message": 7, "raw": 7},
    ],
)
def test_nonsense_is_an_error_all_the_same(data: Any) -> None:
    for error in ({"code": FAILED, "message": "m", "data": data}, {"data": data}, data):
        raised = decoded(error)
        assert isinstance(raised, ServobusError)
        assert str(raised)
