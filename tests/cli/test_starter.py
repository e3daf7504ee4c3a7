"""The config that `scan --yaml` prints: it is valid for every list of hits."""

from __future__ import annotations

from dataclasses import replace

import pytest

from servobus.cli.scan import ScanTarget
from servobus.cli.starter import starter
from servobus.config.loader import parse_config
from servobus.values import ScanHit

PORT = "/dev/serial/by-id/usb-1a86: #1"
LINE = ScanTarget("line", "sms", PORT)
STS = ScanHit("line", 1, 1_000_000, "sts", "STS3215", "3.10")
SMS = ScanHit("line", 7, 115_200, "sms", None, None)


def test_all_hits_at_one_rate_are_in_the_config() -> None:
    made = starter(LINE, [STS, replace(STS, id=0), replace(STS, id=253)])
    bus = parse_config(made, "made").buses["line"]
    assert (bus.port, bus.baudrate) == (PORT, 1_000_000)
    assert {name: servo.id for name, servo in bus.servos.items()} == {"servo_1": 1, "servo_0": 0, "servo_253": 253}
    assert "Not in it" not in made


@pytest.mark.parametrize("order", [1, -1])
def test_the_commonest_rate_is_chosen(order: int) -> None:
    made = starter(LINE, [SMS, STS, replace(STS, id=2)][::order])
    bus = parse_config(made, "made").buses["line"]
    assert bus.baudrate == 1_000_000
    assert set(bus.servos) == {"servo_1", "servo_2"}
    assert "# Not in it: id 7 at 115200 baud, sms: a line has one rate" in made


def test_a_hit_without_a_model_becomes_a_comment() -> None:
    doubled = ScanHit("line", 3, 1_000_000, None, None, None, "answers, but not who it is: two servos with this id?")
    made = starter(LINE, [STS, doubled, replace(doubled, id=4, note="", product="XY 9.9")])
    assert set(parse_config(made, "made").buses["line"].servos) == {"servo_1"}
    assert (
        "# Not in it: id 3 at 1000000 baud, no model file fits it (answers, but not who it is: two servos with this id?)" in made
    )
    assert "(XY 9.9)" in made


def test_hits_without_any_model() -> None:
    made = starter(LINE, [ScanHit("line", 3, 9600, None, None, None)])
    bus = parse_config(made, "made").buses["line"]
    assert (bus.baudrate, bus.servos) == (9600, {})


def test_a_hand_is_its_six_fingers() -> None:
    made = starter(ScanTarget("hands", "roh", PORT), [ScanHit("hands", unit, 115_200, "v2", None, None) for unit in (2, 5)])
    bus = parse_config(made, "made").buses["hands"]
    assert {servo.id for servo in bus.servos.values()} == {2, 5}
    assert len(bus.servos) == 12
    assert {"thumb_bend_2", "thumb_rotation_5"} <= set(bus.servos)
