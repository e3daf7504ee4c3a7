"""Hands behind simulated arms, over real sockets: the same verbs as on a line, and no wrong value whatever the arm sends."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path

import pytest

from servobus.config.loader import Config, parse_config
from servobus.errors import ConfigError, DeviceError, LinkDown, ServobusError
from servobus.links import open_link
from servobus.protocols.roh import DEFINITION
from servobus.protocols.roh.simulated.device import RohDevice
from servobus.rig.local import LocalRig, open_rig
from servobus.simulation.arm_server import ArmFaults, ArmServer
from servobus.values import Outcome

pytestmark = pytest.mark.slow

FINGERS = ("thumb_bend", "index", "middle", "ring", "little", "thumb_rotation")
GENERATIONS = pytest.mark.parametrize("generation", [2, 3, 4])


def config(port: int, *, keys: str = "", poll: str = "{}") -> Config:
    servos = "".join(f"      {finger}: {{id: 2, channel: {finger}}}\n" for finger in FINGERS)
    text = (
        f"version: 1\nbuses:\n  hand:\n    protocol: roh\n    port: realman://127.0.0.1:{port}?port=1{keys}\n"
        f"    poll: {poll}\n    servos:\n{servos}"
    )
    return parse_config(text, "arm", Path())


@asynccontextmanager
async def arm(generation: int = 3, faults: ArmFaults | None = None) -> AsyncIterator[tuple[ArmServer, RohDevice]]:
    """An arm and the hand behind it."""
    setup = config(1)
    (hand,) = DEFINITION.devices(setup.buses["hand"], setup.models["hand"])
    assert isinstance(hand, RohDevice)
    async with ArmServer([hand], generation, faults) as server:
        yield server, hand


@asynccontextmanager
async def behind(
    generation: int = 3, faults: ArmFaults | None = None, *, keys: str = ""
) -> AsyncIterator[tuple[LocalRig, RohDevice, ArmServer]]:
    async with arm(generation, faults) as (server, hand), open_rig(config(server.port, keys=keys)) as rig:
        yield rig, hand, server


async def until(true: Callable[[], bool]) -> None:
    async with asyncio.timeout(10):
        while not true():  # noqa: ASYNC110 - there is no event to wait for
            await asyncio.sleep(0.002)


@GENERATIONS
async def test_the_same_verbs_as_on_a_line(generation: int) -> None:
    async with behind(generation) as (rig, hand, server):
        assert server.arm.modes == {1: 115_200}
        assert (await rig.identify("index")).model == "v2"
        assert await rig.ping("index") is None
        await rig.enable()
        hand.written.clear()
        assert set((await rig.move(dict.fromkeys(FINGERS, 40.0))).values()) == {Outcome.ACKED}
        assert hand.written == [(1135 + number, 26214) for number in range(6)]
        assert (await rig["index"].settle()).position == pytest.approx(40, abs=1)
        assert await rig.write_register("ring", "stall_speed", 30) == 30
        assert await rig.read_register("index", "1000:4") == [0x0200, 0x0301, 155, 0x2001]
        with pytest.raises(DeviceError, match="gateway: the unit did not answer"):
            await rig.read_register("index", "1990:1")
        reports = await rig.stop()
        assert all(report.confirmed for report in reports.values())
        await rig.clear()
        await rig.disable()
        assert [hit.id for hit in await rig.scan("hand", ids=range(1, 4))] == [2]
    assert server.arm.modes == ({1: 115_200} if generation == 4 else {}), "the port is given back"


@pytest.mark.parametrize(("generation", "longest"), [(3, 12), (4, 64)])
async def test_what_an_arm_carries_is_kept_to(generation: int, longest: int) -> None:
    async with behind(generation) as (rig, hand, _):
        hand._memory.update({1185 + at: 100 + at for at in range(100) if 1185 + at in hand._memory})
        values = await rig.read_register("index", f"1185:{longest}")
        assert values == [100 + at for at in range(longest)]
        with pytest.raises(ServobusError, match=f"LEN 1 to {longest}"):
            await rig.read_register("index", f"1185:{longest + 1}")


async def test_a_failure_is_explained_by_the_hand() -> None:
    async with behind() as (rig, hand, _):
        await rig.enable("index")
        hand.fails[1136] = 4
        with pytest.raises(DeviceError, match="a motor is stuck") as caught:
            await rig["index"].move_to(50)
        assert caught.value.code == 0x0B


FAULTS = {
    "duplicate": ArmFaults(duplicate=1.0),
    "some duplicates": ArmFaults(duplicate=0.3, split=0.3, seed=5),
    "split": ArmFaults(split=1.0),
    "chatter": ArmFaults(chatter=1.0, split=0.5, seed=2),
    "late": ArmFaults(late=0.1, late_s=0.2, seed=3),
}


@GENERATIONS
@pytest.mark.parametrize("name", FAULTS)
async def test_no_value_is_another_ones(name: str, generation: int) -> None:
    async with behind(generation, FAULTS[name]) as (rig, hand, _):
        right = 0
        for number in range(12):
            first, second = number, 1000 + number
            hand._memory[1186], hand._memory[1188] = first, second
            with suppress(ServobusError):
                assert await rig.read_register("index", "stall_speed") == first
                right += 1
            with suppress(ServobusError):
                assert await rig.read_register("ring", "stall_speed") == second
                right += 1
        assert right > 12
        assert name == "late" or right == 24


@pytest.mark.parametrize("faults", [ArmFaults(cut=1.0), ArmFaults(drop=1.0)], ids=["cut", "drop"])
async def test_an_arm_that_falls_silent_or_hangs_up_is_called_again(faults: ArmFaults) -> None:
    async with arm() as (server, hand), open_rig(config(server.port)) as rig:
        for number in range(2):
            server.faults = faults
            hand._memory[1186] = number
            with pytest.raises(ServobusError):
                await rig.read_register("index", "stall_speed")
            await until(lambda: rig.snapshot()["hand/index"].health != "online")
            server.faults, hand._memory[1186] = ArmFaults(), 100 + number
            await until(lambda: rig.snapshot()["hand/index"].health == "online")
            assert await rig.read_register("index", "stall_speed") == 100 + number


async def test_a_read_fails_while_the_arm_is_gone_and_works_again_later() -> None:
    async with behind() as (rig, hand, server):
        hand.extra_delay = 0.5
        reading = asyncio.create_task(rig.read_register("index", "stall_speed"))
        await until(lambda: bool(rig.buses["hand"].engine.in_flight))
        server.hang_up()
        with pytest.raises(LinkDown, match=r"closed the connection|was lost"):
            await reading
        hand.extra_delay = 0.0
        await until(lambda: rig.buses["hand"].master.up)
        assert await rig.read_register("index", "stall_speed") == 16


async def test_an_arm_that_refuses_the_mode_says_what_to_do() -> None:
    async with arm() as (server, _):
        server.arm.refuses_modes = True
        with pytest.raises(LinkDown, match="does not make port 1 a Modbus master: switch"):
            async with open_rig(config(server.port)):
                raise AssertionError


async def test_a_pinned_generation_that_is_another() -> None:
    async with arm(3) as (server, _):
        with pytest.raises(LinkDown, match="of generation 3: take generation=4 out"):
            async with open_rig(config(server.port, keys="&generation=4")):
                raise AssertionError


async def test_the_tools_power_is_switched_only_when_asked() -> None:
    async with behind() as (_, _, server):
        assert server.arm.voltage == 0
    async with behind(keys="&voltage=24") as (_, _, server):
        assert server.arm.voltage == 3


async def test_somebody_who_is_no_arm() -> None:
    async def mumble(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while await reader.read(99):
            writer.write(b"220 welcome\r\n" + b"[" * 5000 + b"\r\n")
        writer.close()
        await writer.wait_closed()

    server = await asyncio.start_server(mumble, "127.0.0.1", 0)
    async with server:
        with pytest.raises(LinkDown, match="does not answer as a RealMan arm does"):
            async with open_rig(config(server.sockets[0].getsockname()[1])):
                raise AssertionError
    with pytest.raises(LinkDown, match="no program listens there"):
        async with open_rig(config(server.sockets[0].getsockname()[1] if server.sockets else 1)):
            raise AssertionError


@pytest.mark.parametrize(
    "port",
    [
        "realman://h",
        "realman://h:1?port=2",
        "realman://h:1?port=1&port=0",
        "realman://h:1?speed=9",
        "realman://h:1/x",
        "realman://:1",
    ],
)
def test_ports_that_cannot_be_read(port: str) -> None:
    with pytest.raises(ConfigError, match=r"write realman://HOST:PORT\?port=1"):
        open_link(port, 115_200)


def test_only_modbus_passes_through_an_arm() -> None:
    text = "version: 1\nbuses: {arm: {protocol: sms, port: 'realman://h:1', baudrate: 9600, servos: {s: {id: 1, model: sts}}}}\n"
    with pytest.raises(ConfigError, match=r"arm:2:36: .*realman:// carries roh alone"):
        parse_config(text, "arm")
