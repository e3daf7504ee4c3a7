"""The same app code moves a joint of any protocol."""

from __future__ import annotations

import pytest

from servobus.config.loader import parse_config
from servobus.errors import EStopped, LimitError, NotEnabled
from servobus.rig.local import open_rig
from servobus.values import Outcome
from tests.virtual_time import virtual

KEYS = "limits: [-45, 45], max_speed: 90"
JOINTS = {
    "sms": f"    protocol: sms\n    baudrate: 1000000\n    servos: {{joint: {{id: 1, model: sts, {KEYS}}}}}\n",
    "kst": f"    protocol: kst\n    baudrate: 512000\n    servos: {{joint: {{id: 37, {KEYS}}}}}\n",
    "roh": f"    protocol: roh\n    baudrate: 115200\n    servos: {{joint: {{id: 2, channel: index, zero: 32768, {KEYS}}}}}\n",
}


@pytest.mark.parametrize("protocol", JOINTS)
@virtual
async def test_one_app_for_every_joint(protocol: str) -> None:
    text = f"version: 1\nbuses:\n  line:\n    port: 'sim:'\n    poll: {{feedback: 50}}\n{JOINTS[protocol]}"
    async with open_rig(parse_config(text, "app")) as rig:
        joint = rig["joint"]
        with pytest.raises(NotEnabled):
            await joint.move_to(10)
        await joint.enable()
        with pytest.raises(LimitError):
            await joint.move_to(45.1)
        assert await joint.move_to(30) is Outcome.ACKED
        state = await joint.settle()
        assert state.position == pytest.approx(30, abs=1)
        assert await joint.move_to(-10, speed=45) is Outcome.ACKED
        assert (await joint.settle()).position == pytest.approx(-10, abs=1)
        assert await joint.move_to(0, duration=0.5) is Outcome.ACKED
        reports = await rig.stop()
        assert reports["line/joint"].confirmed
        with pytest.raises(EStopped):
            await joint.move_to(0)
        await rig.clear()
        await joint.disable()
        async for snapshot in rig.watch(hz=50):
            assert not snapshot["line/joint"].enabled
            break


@virtual
async def test_the_host_keeps_the_speed_and_stops_a_servo_without_speed() -> None:
    text = f"version: 1\nbuses:\n  line:\n    port: 'sim:'\n    goal_rate: 100\n    poll: {{feedback: 100}}\n{JOINTS['kst']}"
    async with open_rig(parse_config(text, "app")) as rig:
        joint = rig["joint"]
        await joint.enable()
        await joint.move_to(45, speed=30)
        positions: list[float] = []
        async for snapshot in rig.watch(hz=20):
            position = snapshot["line/joint"].position
            assert position is not None
            positions.append(position)
            if len(positions) == 21:
                break
        assert positions[-1] - positions[0] == pytest.approx(30, abs=2), "one second at 30 degrees/s"
        await rig.stop()
        stopped = (await joint.read()).position
        await rig.clear()
        async for snapshot in rig.watch(hz=2):
            if len(positions) == 23:
                break
            positions.append(snapshot["line/joint"].position or 0.0)
        assert positions[-1] == stopped, "no setpoint is sent any more"
