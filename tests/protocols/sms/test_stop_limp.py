"""A stop that switches torque off never switches it on again."""

from __future__ import annotations

import pytest

from servobus.protocols.sms.codec import Instruction
from tests.protocols.sms.bench import Bench
from tests.protocols.sms.states import FAMILIES
from tests.protocols.sms.test_stop import stop, target


@pytest.mark.parametrize("family", FAMILIES)
def test_a_silent_servo_that_goes_limp_gets_no_position(family: str) -> None:
    bench = Bench({"a": {"id": 1, "model": family}})
    bench.enable()
    bench.is_unanswered = lambda packet: packet.code == Instruction.READ
    report = stop(bench, target("a", "limp", position=0.0))["a"]
    assert (report.action, report.written, report.confirmed) == ("limp", True, False)
    assert bench.register(1, "torque_enable") == 0
