"""Links to simulated lines: the port, the traits, and what outlives a connection."""

from __future__ import annotations

import asyncio
from contextlib import closing
from typing import Any, cast

import pytest

from servobus.errors import ConfigError
from servobus.protocols.base import LineTraits
from servobus.protocols.sms.codec import Instruction, encode
from servobus.protocols.sms.model import packaged_models
from servobus.protocols.sms.options import SmsBus
from servobus.protocols.sms.simulated.device import SmsDevice
from servobus.simulation.link import SimulatedLink, has_wire_time, simulated_link
from tests.virtual_time import virtual

PING = encode(1, Instruction.PING)
ACK = encode(1, 0)


class Receiver(asyncio.Protocol):
    """Records what it receives, and whether the end was reported."""

    def __init__(self) -> None:
        self.received = b""
        self.lost = False
        self._news = asyncio.Event()

    def data_received(self, data: bytes) -> None:
        self.received += data
        self._news.set()

    async def until(self, count: int) -> bytes:
        """Return what was received, once it has this many bytes."""
        async with asyncio.timeout(1):
            while len(self.received) < count:
                self._news.clear()
                await self._news.wait()
        return self.received

    def connection_lost(self, exc: Exception | None) -> None:
        self.lost = True


def link_of(*, wire_time: bool = True, **keys: Any) -> SimulatedLink:
    data = {"protocol": "sms", "port": "sim:", "baudrate": 1_000_000, "servos": {"a": {"id": 1, "model": "sts"}}, **keys}
    return simulated_link(SmsBus.model_validate(data), packaged_models(), wire_time=wire_time)


def test_a_port_says_whether_bytes_take_time() -> None:
    """Two forms, and an error that names both for anything else."""
    assert (has_wire_time("sim:"), has_wire_time("sim:?wire_time=off")) == (True, False)
    for port in ("sim", "sim:?wire_time=on", "sim:arm", "/dev/ttyUSB0"):
        with pytest.raises(ConfigError, match='not a simulated line: write "sim:" or "sim:\\?wire_time=off"') as caught:
            has_wire_time(port)
        assert port in str(caught.value)


@pytest.mark.parametrize(
    ("keys", "traits"),
    [
        ({}, LineTraits(1_000_000, paced=True, can_change_baud=True)),
        ({"baudrate": 115_200}, LineTraits(115_200, paced=True, can_change_baud=True)),
        ({"faults": {"loss": 0.5}}, LineTraits(1_000_000, paced=True, can_change_baud=True)),
        ({"faults": {"echo": 0.01}}, LineTraits(1_000_000, paced=False, can_change_baud=True)),
        ({"port": "sim:?wire_time=off"}, LineTraits(can_change_baud=True)),
        ({"wire_time": False}, LineTraits(can_change_baud=True)),
    ],
)
@virtual
async def test_the_link_states_what_its_line_is(keys: dict[str, Any], traits: LineTraits) -> None:
    """An injected echo takes no wire time, and the traits of the line say so."""
    with closing(link_of(**keys)) as link:
        assert link.traits == traits
        assert link.address == keys.get("port", "sim:")


@virtual
async def test_servos_outlive_connections() -> None:
    """What was written before the plug was pulled is there after it; the devices are at hand all the time."""
    with closing(link_of()) as link:
        (device,) = cast("list[SmsDevice]", link.line.devices)
        first, second = Receiver(), Receiver()
        (await link.connect(first)).write(encode(1, Instruction.WRITE, b"\x2e\x07\x00"))
        assert await first.until(6) == ACK
        link.unplug()
        await asyncio.sleep(0)
        assert first.lost
        link.plug()
        (await link.connect(second)).write(encode(1, Instruction.READ, b"\x2e\x01"))
        assert await second.until(7) == encode(1, 0, b"\x07")
        assert device.get("goal_speed") == 7


@virtual
async def test_a_line_is_opened_at_the_rate_of_its_config() -> None:
    """Whatever rate the last connection ended with."""
    with closing(link_of()) as link:
        first, second = Receiver(), Receiver()
        transport = await link.connect(first)
        transport.set_baudrate(9_600)
        transport.write(PING)
        transport.abort()
        (await link.connect(second)).write(PING)
        assert (await second.until(6), first.received) == (ACK, b"")


@virtual
async def test_faults_stand_between() -> None:
    """Every reply is sent twice."""
    with closing(link_of(faults={"duplicate": 1.0})) as link:
        receiver = Receiver()
        (await link.connect(receiver)).write(PING)
        assert await receiver.until(12) == 2 * ACK


@virtual
async def test_a_closed_link_is_silent() -> None:
    """The next one is another line, with other servos."""
    receiver, other = Receiver(), Receiver()
    with closing(link_of()) as link:
        (await link.connect(receiver)).write(PING)
    with closing(link_of()) as link:
        (await link.connect(other)).write(PING)
        assert (await other.until(6), receiver.received) == (ACK, b"")
