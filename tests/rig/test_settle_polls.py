"""Arrival on a bus whose polls bring the position alone."""

from __future__ import annotations

from pathlib import Path

import servobus
from servobus.config.loader import parse_config
from tests.virtual_time import virtual

HAND = """
version: 1
buses:
  hand:
    protocol: roh
    port: "sim:"
    baudrate: 115200
    poll: {feedback: 100}
    servos:
      index: {id: 2, channel: index, limits: [0, 100]}
"""


@virtual
async def test_a_finger_settles_though_no_poll_brings_its_status() -> None:
    async with servobus.open(parse_config(HAND, "hand.yaml", Path())) as rig:
        await rig.enable()
        await rig["index"].move_to(40)
        assert (await rig["index"].read()).moving
        assert not (await rig["index"].settle(timeout=5)).moving
