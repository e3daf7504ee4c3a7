"""What the commands share: how a rig is opened and left, how cells and numbers are shown."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import pytest

from servobus.cli.output import show, table
from servobus.cli.rig_context import Options, opened
from servobus.errors import DeviceError
from servobus.rig.interface import Rig
from servobus.rig.local import LocalRig
from servobus.simulation.link import SimulatedLink
from tests.config.mistakes import GOOD


@pytest.fixture
def options(tmp_path: Path) -> Options:
    path = tmp_path / "rig.yaml"
    path.write_text(GOOD)
    return Options(str(path), as_json=False, trace=False, dry_run=False)


def silence(rig: Rig) -> None:
    """From here on nobody answers."""
    cast("SimulatedLink", cast("LocalRig", rig).supervisors["arm"].link).line.close()


async def test_how_servos_were_left_is_told_when_nobody_confirms_it(options: Options) -> None:
    with pytest.raises(DeviceError, match=r"how it was left: arm/shoulder \(hold: .+\); look") as caught:  # noqa: PT012 - at the end
        async with opened(options, ["shoulder"]) as rig:
            await rig.enable("shoulder")
            silence(rig)
    assert caught.value.exit_status == 1


async def test_what_went_wrong_before_is_told_first(options: Options) -> None:
    with pytest.raises(ValueError, match="first"):  # noqa: PT012 - it is raised by the last statement
        async with opened(options, ["shoulder"]) as rig:
            await rig.enable("shoulder")
            silence(rig)
            raise ValueError("first")


async def test_servos_that_confirm_how_they_are_left(options: Options) -> None:
    async with opened(options) as rig:
        await rig.enable()
    assert {name: (report.action, report.confirmed) for name, report in cast("LocalRig", rig).left.items()} == {
        "arm/shoulder": ("hold", True),
        "arm/elbow": ("hold", True),
    }


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (None, "-"),
        (True, "yes"),
        (False, "no"),
        (1.005, "1.00"),
        (-20, "-20"),
        (("a", "b"), "a, b"),
        ([1, 2], "1, 2"),
        ("x", "x"),
    ],
)
def test_cells(value: object, shown: str) -> None:
    assert show(value) == shown


def test_numbers_stand_right_and_words_left() -> None:
    made = table(None, ("name", "value", "mixed"), [("a", 1.5, 1), ("b", None, "x")])
    assert [column.justify for column in made.columns] == ["left", "right", "left"]
