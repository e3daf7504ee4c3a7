"""How much code one read of a register runs through: what a reader has to follow, and what the CPU has to do."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import pytest

import servobus
from servobus.links.memory import MemoryLink
from servobus.protocols.base import LineTraits
from servobus.protocols.sms.codec import encode
from servobus.rig.local import LocalRig
from tests.engine.scripted_line import Puppet
from tests.simulated_rigs import config
from tests.virtual_time import virtual

PACKAGE = Path(servobus.__file__).parent
MAX_CALLS, MAX_FILES = 60, 12


@contextmanager
def counted_calls() -> Iterator[list[tuple[str, str]]]:
    """The Python functions of servobus that are called meanwhile, with their files."""
    calls: list[tuple[str, str]] = []

    def note(frame: FrameType, event: str, _: object) -> None:
        path = Path(frame.f_code.co_filename)
        if event == "call" and path.is_relative_to(PACKAGE):
            calls.append((str(path.relative_to(PACKAGE)), frame.f_code.co_name))

    sys.setprofile(note)
    try:
        yield calls
    finally:
        sys.setprofile(None)


@pytest.mark.parametrize(("raw", "value"), [(True, 0x234), (False, -130.4)])
@virtual
async def test_a_read_on_an_idle_bus_takes_few_calls_in_few_files(raw: bool, value: float) -> None:
    rig = LocalRig(config("s1: {id: 1, model: sts}", "s2: {id: 2, model: sts}"), supervisors=None)  # type: ignore[arg-type]
    bus, puppet = rig.buses["arm"], Puppet()
    await MemoryLink(puppet, LineTraits(baudrate=1_000_000)).connect(bus.master)
    await bus.start()
    reply = [(0.001, encode(1, 0, b"\x34\x02"))]
    puppet.script = lambda frame: reply
    await rig.read_register("s1", "present_position", raw=raw)
    with counted_calls() as calls:
        assert await rig.read_register("s1", "present_position", raw=raw) == pytest.approx(value, abs=0.1)
    await rig.close()
    listing = "\n".join(f"{file}: {function}" for file, function in calls)
    assert len(calls) <= MAX_CALLS, listing
    assert len({file for file, _ in calls}) <= MAX_FILES, listing
