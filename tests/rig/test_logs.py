"""As a library servobus is silent; a program that configures logging reads events, and a formatter finds their fields."""

from __future__ import annotations

import logging
import subprocess
import sys

import pytest

from servobus.rig.logs import EventLogger
from servobus.values import EventName

DEAD_SERVO = """
import asyncio, servobus
from servobus.config.loader import parse_config
from pathlib import Path
{configure}
text = '''
version: 1
buses:
  arm:
    protocol: sms
    port: "sim:"
    baudrate: 1000000
    poll: {{feedback: 50}}
    servos: {{s1: {{id: 1, model: sts}}}}
'''
async def main():
    async with servobus.open(parse_config(text, "arm.yaml", Path())) as rig:
        rig.supervisors["arm"].link.line.devices[0].dead = True
        events = rig.events()
        while (await anext(events)).name != "servo_offline":
            pass
        await rig.stop()
asyncio.run(main())
"""


def run(configure: str) -> subprocess.CompletedProcess[str]:
    code = DEAD_SERVO.format(configure=configure)
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)


@pytest.mark.slow
def test_a_library_program_with_a_dead_servo_prints_nothing() -> None:
    process = run("")
    assert (process.stdout, process.stderr) == ("", "")


@pytest.mark.slow
def test_a_program_that_configures_logging_reads_events() -> None:
    process = run("import logging; logging.basicConfig(level=logging.INFO)")
    assert "WARNING:servobus.rig:servo_offline: bus=arm servo=s1 id=1" in process.stderr
    assert "WARNING:servobus.rig:estop\n" in process.stderr
    assert process.stdout == ""


def test_a_record_carries_event_and_fields(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, "servobus"):
        EventLogger("servobus.test").info(EventName.LINE_UP, bus="arm", process="any key may be used")
    (record,) = caplog.records
    assert record.getMessage() == "line_up: bus=arm process=any key may be used"
    assert vars(record)["servobus_event"] == "line_up"
    assert vars(record)["servobus_fields"] == {"bus": "arm", "process": "any key may be used"}
    assert record.funcName == "test_a_record_carries_event_and_fields"
