"""Keys of every bus and servo: what fits together and what does not."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from servobus.protocols.options import BusOptions, PollRates, ServoOptions
from servobus.protocols.sms.model import packaged_models

BUS = {"protocol": "sms", "port": "sim:", "baudrate": 115200}


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"limits": [5, 5]}, "the first must be below the second"),
        ({"limits": [0, float("inf")]}, "must be a finite number"),
        ({"on_estop": "park"}, "park needs a park_pose"),
        ({"on_exit": "park"}, "park needs a park_pose"),
        ({"on_lost_client": "park"}, "park needs a park_pose"),
        ({"on_exit": "park", "park_pose": 10.1, "limits": [0, 10]}, "park_pose 10.1 is outside limits"),
        ({"speed": 10.1, "max_speed": 10}, "speed 10.1 is above max_speed 10"),
        ({"speed": 0}, "greater than 0"),
        ({"gear": 0.0009}, "greater than or equal to 0.001"),
        ({"gear": 1000.1}, "less than or equal to 1000"),
        ({"zero": 1.1e9}, "less than or equal to 1000000000"),
        ({"direction": 2}, "Input should be 1 or -1"),
        ({"torque_limit": 100.1}, "less than or equal to 100"),
        ({"torque_limit": 0}, "greater than 0"),
        ({"ttl": -1}, "greater than 0"),
        ({"on_exit": "fall"}, "'hold', 'limp' or 'park'"),
        ({"id": 1.5}, "valid integer"),
        ({"id": True}, "valid integer"),
        ({"speeed": 1}, "Extra inputs"),
    ],
)
def test_what_does_not_fit(keys: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        ServoOptions.model_validate({"id": 1, **keys})


@pytest.mark.parametrize(
    "keys",
    [
        {"limits": [-1, 1]},
        {"on_exit": "park", "park_pose": 10, "limits": [0, 10]},
        {"speed": 10, "max_speed": 10},
        {"torque_limit": 100},
        {"direction": -1, "gear": 2.5},
        {"gear": 0.001, "zero": -1e9},
        {"gear": 1000, "zero": 1e9},
    ],
)
def test_what_fits_at_its_edge(keys: dict[str, Any]) -> None:
    assert ServoOptions.model_validate({"id": 1, **keys}).key == 1


def test_calibration() -> None:
    model = packaged_models()["sts"]
    plain = ServoOptions(id=1).calibration(model)
    assert (plain.zero, plain.direction, plain.unit_per_step) == (2048, 1, 360 / 4096)
    turned = ServoOptions(id=1, zero=1000, direction=-1, gear=2, unit="step").calibration(model)
    assert turned.to_unit(1010) == -5
    assert turned.to_raw(-5) == 1010
    assert turned.rate_to_unit(10) == -5
    assert turned.rate_to_raw(-5) == 10
    assert str(plain.to_unit(2048)) == str(ServoOptions(id=1, direction=-1).calibration(model).to_unit(2048)) == "0.0"


def test_ties_go_to_the_even_step() -> None:
    step = ServoOptions(id=1, zero=0, unit="step").calibration(packaged_models()["sts"])
    assert [step.to_raw(value) for value in (0.5, 1.5, 2.5, -0.5, -1.5)] == [0, 2, 2, 0, -2]


def test_faults_belong_to_simulated_lines() -> None:
    assert BusOptions.model_validate({**BUS, "faults": {"loss": 1}}).faults
    with pytest.raises(ValidationError, match="faults are for a simulated line"):
        BusOptions.model_validate({**BUS, "port": "/dev/ttyUSB0", "faults": {"loss": 0.1}})
    with pytest.raises(ValidationError, match="less than or equal to 1"):
        BusOptions.model_validate({**BUS, "faults": {"loss": 1.01}})


@pytest.mark.parametrize(("rate", "right"), [(300, True), (299, False), (10_000_000, True), (10_000_001, False)])
def test_baud_rates_at_their_edges(rate: int, right: bool) -> None:
    if right:
        assert BusOptions.model_validate({**BUS, "baudrate": rate}).baudrate == rate
    else:
        with pytest.raises(ValidationError, match="baudrate"):
            BusOptions.model_validate({**BUS, "baudrate": rate})


@pytest.mark.parametrize(("length", "right"), [(0, False), (1, True), (255, True), (256, False)])
def test_lengths_of_ports_at_their_edges(length: int, right: bool) -> None:
    if right:
        assert BusOptions.model_validate({**BUS, "port": "/" * length}).port
    else:
        with pytest.raises(ValidationError, match="port"):
            BusOptions.model_validate({**BUS, "port": "/" * length})


def test_rates() -> None:
    assert PollRates(feedback=50, health=1).rates() == {"feedback": 50, "health": 1}
    assert PollRates().rates() == {}
    assert BusOptions.model_validate(BUS).rate_of_goals == 50
    assert BusOptions.model_validate({**BUS, "poll": {"feedback": 20}}).rate_of_goals == 20
    assert BusOptions.model_validate({**BUS, "goal_rate": 100, "poll": {"feedback": 20}}).rate_of_goals == 100
    with pytest.raises(ValidationError, match="less than or equal to 1000"):
        PollRates(feedback=1001)
