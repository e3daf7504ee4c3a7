"""What the commands share: the rig that they open and leave, and the cells of tables."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import pytest

from servobus.cli.options import Options
from servobus.cli.output import STATE_COLUMNS, show, state_row, table
from servobus.cli.rig_context import open_context
from servobus.errors import DeviceError
from servobus.rig.interface import Rig
from servobus.rig.local import LocalRig
from servobus.simulation.link import SimulatedLink
from servobus.values import State
from tests.config.mistakes import GOOD


@pytest.fixture
def options(tmp_path: Path) -> Options:
    path = tmp_path / "rig.yaml"
    path.write_text(GOOD)
    return Options(str(path), as_json=False, trace=False, dry_run=False)


def silence(rig: Rig) -> None:
    """Ends the line, so that no servo answers any more."""
    cast("SimulatedLink", cast("LocalRig", rig).supervisors["arm"].link).line.close()


async def test_an_unconfirmed_exit_policy_is_an_error(options: Options) -> None:
    with pytest.raises(DeviceError, match=r"how it was left: arm/shoulder \(hold: .+\); check") as caught:  # noqa: PT012 - at the end
        async with open_context(options, ["shoulder"]) as context:
            await context.rig.enable("shoulder")
            silence(context.rig)
    assert caught.value.exit_status == 1


async def test_an_earlier_error_is_raised_first(options: Options) -> None:
    with pytest.raises(ValueError, match="first"):  # noqa: PT012 - it is raised by the last statement
        async with open_context(options, ["shoulder"]) as context:
            await context.rig.enable("shoulder")
            silence(context.rig)
            raise ValueError("first")


async def test_confirmed_exit_policies_are_no_error(options: Options) -> None:
    async with open_context(options) as context:
        await context.rig.enable()
    assert {name: (report.action, report.confirmed) for name, report in cast("LocalRig", context.rig).left.items()} == {
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


@pytest.mark.parametrize(
    ("state", "shown"),
    [
        (State(), None),
        (State(energised=False), None),
        (State(energised=True), "energised"),
        (State(enabled=True, energised=True), "enabled"),
        (State(enabled=True, energised=True, moving=True), "moving"),
    ],
)
def test_a_servo_that_somebody_else_energised_is_shown(state: State, shown: str | None) -> None:
    assert state_row("arm/s1", state)[STATE_COLUMNS.index("state")] == shown


def test_numbers_are_on_the_right_and_text_on_the_left() -> None:
    made = table(None, ("name", "value", "mixed"), [("a", 1.5, 1), ("b", None, "x")])
    assert [column.justify for column in made.columns] == ["left", "right", "left"]
