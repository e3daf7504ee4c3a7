"""The table of verbs: every verb of a rig is at every door, and a new one needs nothing but its row."""

from __future__ import annotations

import inspect
from collections.abc import Iterable
from typing import Any

import msgspec
import pytest

from servobus import blocking
from servobus.daemon.methods import HANDLERS
from servobus.remote.rig import RemoteRig
from servobus.rig.interface import Rig, Servo
from servobus.rig.local import LocalRig
from servobus.rig.verbs import VERBS, Verb, arguments, caller, fields, servos
from servobus.rpc.methods import METHODS, method_of
from servobus.values import Goal, Role
from tests.simulated_rigs import config
from tests.virtual_time import virtual


def coroutines(interface: type) -> set[str]:
    return {name for name, value in vars(interface).items() if inspect.iscoroutinefunction(value) and not name.startswith("_")}


def test_every_verb_has_a_row() -> None:
    assert VERBS.keys() == coroutines(Rig) | coroutines(Servo)
    for name, verb in VERBS.items():
        assert verb.of_servo is (not hasattr(Rig, name))


@pytest.mark.parametrize("name", VERBS)
def test_every_verb_is_at_every_door(name: str) -> None:
    verb = VERBS[name]
    assert (name in METHODS) is verb.door
    assert (name in HANDLERS) is verb.door
    if not verb.of_servo:
        for kind in (LocalRig, RemoteRig, blocking.BlockingRig):
            assert inspect.signature(getattr(kind, name), eval_str=False) == inspect.signature(verb.function)
        assert inspect.getdoc(getattr(RemoteRig, name)), "a remote rig documents it"
    if hasattr(Servo, name):
        assert inspect.signature(getattr(blocking.BlockingServo, name)) == inspect.signature(getattr(Servo, name))


class ToyRig(LocalRig):
    """A rig with one verb more, as a programmer would add it: signature, docstring, work."""

    async def wave(self, name: str, times: int = 1, *, speeds: Iterable[float] = (), loud: bool = False) -> dict[str, int]:
        """Wave."""
        return {self.full_name(name): times * (2 if loud else 1) + len(list(speeds))}


@virtual
async def test_a_toy_verb_needs_nothing_but_its_row() -> None:
    import anyio

    verb = Verb(ToyRig.wave, Role.OPERATOR)
    assert fields(verb) == [("name", str), ("times", int, 1), ("speeds", tuple[float, ...], ()), ("loud", bool, False)]
    method = method_of(verb)
    params: Any = msgspec.json.decode(b'{"name": "s1", "times": 3, "speeds": [1, 2], "loud": true}', type=method.params)
    async with anyio.create_task_group() as group:
        rig = ToyRig(config(), group)
        assert servos(verb, rig, params) == ["arm/s1"]
        assert await caller(verb)(rig, params) == {"arm/s1": 8}
    assert method.result == dict[str, int]
    assert arguments(verb, ("s1",), {"loud": True}) == {"name": "s1", "times": 1, "speeds": (), "loud": True}
    with pytest.raises(TypeError, match="unexpected keyword argument"):
        arguments(verb, ("s1",), {"quiet": True})


@virtual
async def test_which_servos_a_message_is_about() -> None:
    import anyio

    async with anyio.create_task_group() as group:
        rig = LocalRig(config(), group)

        def about(verb: str, **params: Any) -> list[str]:
            return servos(VERBS[verb], rig, METHODS[verb].params(**params))

        assert about("move_to", name="s2", position=1) == ["arm/s2"]
        assert about("move", positions={"s1": 1, "arm/s3": 2}) == ["arm/s1", "arm/s3"]
        assert about("send_all", goals={"s1": Goal("position", 1)}) == ["arm/s1"]
        assert about("enable", names=("s3",)) == ["arm/s3"]
        assert about("enable") == about("set_id", bus="arm", node=1, new=2) == ["arm/s1", "arm/s2", "arm/s3"]
        assert about("command", bus="leg", node=1, name="restart") == []
