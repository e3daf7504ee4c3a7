"""The page about writing a driver: its code blocks make a protocol that works, from the codec to a rig."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any, cast

import pytest

from servobus.config.loader import Config
from servobus.errors import LimitError, NotEnabled, ReplyTimeout
from servobus.protocols.definition import ProtocolDefinition
from servobus.protocols.registry import PROTOCOLS
from servobus.rig.local import LocalRig, open_rig
from servobus.simulation.link import SimulatedLink
from servobus.values import Outcome
from tests.protocols.contract import CHECKS, Joined
from tests.virtual_time import virtual

PAGE = Path(__file__).parents[2] / "docs" / "writing-a-driver.md"
BLOCK = re.compile(r"^```\w+ (toy/\S+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
HOST_HALF = ("codec.py", "requests.py", "options.py", "driver.py")
MAX_LINES = 250
SERVOS = {"a": {"id": 1, "limits": [-90.0, 90.0]}, "b": {"id": 2, "direction": -1}}
PING, GET, GOAL = 1, 2, 3


def files_of_the_page() -> dict[str, str]:
    """The files that the code blocks are; blocks of one file are joined in the order of the page."""
    files: dict[str, str] = {}
    for name, text in BLOCK.findall(PAGE.read_text()):
        files[name] = f"{files[name]}\n{text}" if name in files else text
    return files


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ProtocolDefinition]:
    """The package of the page, in the registry."""
    folder = tmp_path_factory.mktemp("protocols")
    for name, text in files_of_the_page().items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    sys.path.insert(0, str(folder))
    try:
        definition: ProtocolDefinition = import_module("toy").DEFINITION
        PROTOCOLS["toy"] = definition
        yield definition
    finally:
        PROTOCOLS.pop("toy", None)
        sys.path.remove(str(folder))
        for name in [name for name in sys.modules if name.partition(".")[0] == "toy"]:
            del sys.modules[name]


def config(definition: ProtocolDefinition) -> Config:
    keys = {"protocol": "toy", "port": "sim:", "baudrate": 115_200, "poll": {"feedback": 20.0}, "servos": SERVOS}
    options = definition.options.model_validate(keys)
    return Config(version=1, buses={"arm": options}, models={"arm": definition.models(options, Path())})


def devices(rig: LocalRig) -> dict[int, Any]:
    link = cast("SimulatedLink", rig.supervisors["arm"].link)
    return {device.node: device for device in link.line.devices}


def test_the_host_half_is_short() -> None:
    files = files_of_the_page()
    lines = [line for name in HOST_HALF for line in files[f"toy/{name}"].splitlines()]
    assert len(lines) < MAX_LINES


@pytest.mark.parametrize("check", CHECKS)
def test_the_page_holds_to_the_contract(toy: ProtocolDefinition, check: Callable[[Joined], None]) -> None:
    check(Joined(toy, "toy", SERVOS))


@virtual
async def test_a_rig_reads_enables_moves_and_stops(toy: ProtocolDefinition) -> None:
    async with open_rig(config(toy)) as rig:
        assert (await rig["a"].read()).position == 0.0
        assert (await rig["a"].identify()).firmware == "7"
        assert await rig["a"].read_register("firmware") == 7
        with pytest.raises(NotEnabled):
            await rig["a"].move_to(10)
        await rig.enable()
        assert await rig["a"].move_to(10) is Outcome.ACKED
        await rig["a"].settle()
        assert (await rig["a"].read()).position == 10.0
        with pytest.raises(LimitError):
            await rig["a"].move_to(91)
        await rig.move({"a": 20.0, "b": 5.0}, together=True)
        await rig["a"].settle()
        await rig["b"].settle()
        assert (devices(rig)[1].registers[1], devices(rig)[2].registers[1]) == (200, -50)
        reports = await rig.stop()
        assert all((report.action, report.confirmed) == ("hold", True) for report in reports.values())
        await rig.clear()
        await rig.disable("a")
        assert devices(rig)[1].registers[2] == 0
    assert {name: report.action for name, report in rig.left.items()} == {"arm/b": "hold"}


@virtual
async def test_the_host_keeps_the_speed(toy: ProtocolDefinition) -> None:
    async with open_rig(config(toy)) as rig:
        await rig.enable("a")
        devices(rig)[1].log.clear()
        await rig["a"].move_to(10, speed=20)
        await rig["a"].settle()
        goals = [frame.value for frame in devices(rig)[1].log if frame.code == GOAL]
        assert goals == sorted(goals)
        assert goals == list(range(10, 101, 10)), "20 deg/s at 20 Hz is 1 deg a step"


@virtual
async def test_a_lost_reply_is_followed_by_a_fence(toy: ProtocolDefinition) -> None:
    setup = config(toy)
    still = setup.buses["arm"].model_copy(update={"poll": type(setup.buses["arm"].poll)()})
    async with open_rig(Config(version=1, buses={"arm": still}, models=setup.models)) as rig:
        await rig.enable("a")
        device = devices(rig)[1]
        device.log.clear()
        device.mute = 1
        assert await rig["a"].read_register("firmware") == 7, "the request is repeated"
        codes = [(frame.code, frame.value) for frame in device.log]
        assert codes[0] == (GET, 0)
        assert codes[1][0] == PING, "the fence"
        assert codes[2] == (GET, 2), "the fence asks whether an enabled servo has restarted"
        assert codes[3] == (GET, 0)
        device.mute = 1000
        with pytest.raises(ReplyTimeout):
            await rig["a"].read_register("firmware")


@virtual
async def test_a_restart_disables_the_servo(toy: ProtocolDefinition) -> None:
    async with open_rig(config(toy)) as rig:
        await rig.enable("a")
        devices(rig)[1].restart()
        devices(rig)[1].mute = 1
        await rig["a"].read_register("firmware")
        with pytest.raises(NotEnabled):
            await rig["a"].move_to(1)
        assert (await rig["b"].read()).position == 0.0


@virtual
async def test_a_scan_shows_the_servos(toy: ProtocolDefinition) -> None:
    async with open_rig(config(toy)) as rig:
        hits = await rig.scan("arm", ids=range(1, 5))
        assert [(hit.id, hit.model, hit.firmware) for hit in hits] == [(1, "toy", "7"), (2, "toy", "7")]
