"""Public names: each says what it is, with every parameter named; names that are no strings get a clear error."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import servobus
from tests.rig_kinds import Over, both
from tests.simulated_rigs import config
from tests.virtual_time import virtual

UNNAMED = {"self", "cls", "kind", "error", "trace"}


def members() -> Iterator[tuple[str, Any]]:
    for name in servobus.__all__:
        value = getattr(servobus, name)
        if name in {"__version__", "blocking", "Snapshot"}:
            continue
        yield name, value
        if inspect.isclass(value):
            for part, member in vars(value).items():
                if not part.startswith("_") and (inspect.isfunction(member) or isinstance(member, property)):
                    yield f"{name}.{part}", getattr(value, part)
    for name in ("connect", "open"):
        yield f"blocking.{name}", getattr(servobus.blocking, name)


@pytest.mark.parametrize(("name", "member"), [pytest.param(*each, id=each[0]) for each in members()])
def test_every_public_member_is_documented(name: str, member: Any) -> None:
    text = inspect.getdoc(member)
    assert text, f"{name} has no docstring"
    if inspect.isfunction(member):
        for parameter in set(inspect.signature(member).parameters) - UNNAMED:
            assert parameter in text, f"{name}: {parameter} is not named"
    elif dataclasses.is_dataclass(member):
        for field in dataclasses.fields(member):
            assert field.name in text, f"{name}: {field.name} is not named"


def test_the_version_is_that_of_the_package() -> None:
    from importlib.metadata import version

    assert servobus.__version__ == version("servobus")
    assert (Path(servobus.__file__).parent / "py.typed").exists()


@pytest.mark.parametrize("verb", ["enable", "disable", "settle", "acquire", "release"])
@both
@virtual
async def test_a_list_where_names_are_wanted(over: Over, tmp_path: Path, verb: str) -> None:
    async with over(config(), tmp_path) as (rig, _):
        call: Any = getattr(rig, verb)
        with pytest.raises(TypeError, match=r"a string, not \['s1', 's2'\].*enable\(\*names\)"):
            await call(["s1", "s2"])
        with pytest.raises(TypeError, match="a string, not 1"):
            await call(1)


def test_the_same_for_a_blocking_rig() -> None:
    with servobus.blocking.open(config()) as rig:
        call: Any = rig.enable
        with pytest.raises(TypeError, match=r"enable\(\*names\)"):
            call(["s1", "s2"])
