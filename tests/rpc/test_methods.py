"""The table of the door against the interface it stands for."""

from __future__ import annotations

import inspect

import msgspec
import pytest

from servobus.rig.interface import Rig, Servo
from servobus.rpc.methods import METHODS, Method, needed_role
from servobus.values import Outcome, Role, State

LOCAL = {"events", "watch", "full_name", "full_names", "send"}
"""What a client makes of other methods: subscriptions, names it knows, and `send_all` of one."""
OWN = {"hello", "subscribe", "unsubscribe", "cancel", "renew", "leases", "health", "config"}
"""Of the door itself."""


def verbs() -> set[str]:
    return {name for name in vars(Rig) if not name.startswith("_")}


def test_every_verb_of_a_rig_has_a_method() -> None:
    assert verbs() - LOCAL <= METHODS.keys()
    servo = {name for name, value in vars(Servo).items() if inspect.iscoroutinefunction(value)}
    assert servo <= METHODS.keys()
    assert METHODS.keys() == (verbs() - LOCAL) | servo | OWN


@pytest.mark.parametrize("name", sorted(METHODS.keys() & verbs() - {"names", "stopped", "snapshot", "stats"}))
def test_a_method_has_the_parameters_of_its_verb(name: str) -> None:
    verb = inspect.signature(getattr(Rig, name)).parameters
    asked = ["asked"] if METHODS[name].motion else []  # when the caller called
    assert [*verb][1:] + asked == [field.name for field in msgspec.structs.fields(METHODS[name].params)]


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS.keys())
def test_results_and_parameters_can_be_read(method: Method) -> None:
    msgspec.json.Decoder(method.result)
    msgspec.json.Decoder(method.params)
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert({"no such": 1}, method.params)


def test_results_are_read_as_what_they_are() -> None:
    state = State(position=1.0, faults=("hot",), enabled=True)
    assert msgspec.json.decode(msgspec.json.encode({"a": state}), type=METHODS["snapshot"].result) == {"a": state}
    moved = msgspec.json.decode(b'{"a":"acked"}', type=METHODS["move"].result)
    assert moved["a"] is Outcome.ACKED


def test_roles() -> None:
    assert {name for name, method in METHODS.items() if method.role is Role.NOBODY} == {"hello"}
    assert METHODS["stop"].role is Role.OBSERVER  # anyone may stop
    assert {name for name, method in METHODS.items() if method.motion} == {"move", "move_to", "spin", "send_all"}
    assert all(method.role >= Role.OPERATOR for method in METHODS.values() if method.motion)
    assert {name for name, method in METHODS.items() if method.role is Role.ADMIN} == {
        "set_id",
        "set_baudrate",
        "command",
        "reload",
    }
    write = METHODS["write_register"].params
    assert needed_role("write_register", write("s1", "id", 1)) is Role.OPERATOR
    assert needed_role("write_register", write("s1", "id", 1, persist=True)) is Role.ADMIN
