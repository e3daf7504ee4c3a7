"""Who a servo reports to be, and what does not fit the config. Nothing is written."""

from __future__ import annotations

from typing import Any

import pytest

from servobus.protocols.sms.codec import Instruction
from servobus.values import Identity, Outcome
from tests.protocols.sms.bench import Bench


def identity_of(bench: Bench, servo: str = "a") -> Identity:
    identity = bench.run(bench.driver.identify(servo))
    assert {packet.code for packet in bench.sent} == {Instruction.READ}
    return identity


@pytest.mark.parametrize(("model", "product"), [("sms", "SM"), ("sms_cl", "SM"), ("sts", "STS3215"), ("scs", "SCS15")])
def test_each_family_is_identified_by_its_numbers(model: str, product: str) -> None:
    identity = identity_of(Bench({"a": {"id": 1, "model": model}}))
    assert identity.model == model
    assert identity.product is not None
    assert identity.product.startswith(product)
    assert (identity.firmware, identity.mode, identity.energised, identity.notes) == ("3.10", "position", False, ())


def test_an_unconfigured_servo_can_be_inspected() -> None:
    bench = Bench()
    identity = bench.run(bench.driver.inspect(2))
    assert (identity.model, identity.product, identity.firmware) == ("sts", "STS3215", "3.10")


def test_an_unknown_model_number() -> None:
    bench = Bench()
    bench.devices[1].memory.data[3:5] = b"\x63\x63"
    identity = identity_of(bench)
    assert (identity.model, identity.product) == (None, f"model number {0x6363}")


def set_register(bench: Bench, name: str, raw: int) -> None:
    memory = bench.devices[1].memory
    memory.store(memory.registers[name], raw)


@pytest.mark.parametrize(
    ("keys", "registers", "message"),
    [
        ({"model": "sms"}, {}, ""),
        ({}, {"response_status_level": 0}, "its response level is 0, so it answers no write"),
        (
            {"limits": [-170, 170]},
            {"min_angle_limit": 1024, "max_angle_limit": 3072},
            "its own stored limits -90.0 to 90.0 are tighter",
        ),
        (
            {"limits": [-170, 170], "direction": -1},
            {"min_angle_limit": 1024, "max_angle_limit": 4000},
            "stored limits -171.6 to 90.0 are tighter",
        ),
        ({"limits": [-90, 90]}, {"min_angle_limit": 1024, "max_angle_limit": 3072}, ""),
        ({"limits": [-90, 90]}, {"min_angle_limit": 0, "max_angle_limit": 0}, ""),
    ],
)
def test_notes(keys: dict[str, Any], registers: dict[str, int], message: str) -> None:
    bench = Bench({"a": {"id": 1, "model": "sts", **keys}})
    for name, raw in registers.items():
        set_register(bench, name, raw)
    notes = "; ".join(identity_of(bench).notes)
    assert message in notes
    assert bool(notes) is bool(message)


def test_another_model_than_the_config_says() -> None:
    bench = Bench({"a": {"id": 1, "model": "sms"}})
    bench.devices[1].memory.data[3:5] = b"\x09\x03"
    assert "the config says sms: set model: sts" in identity_of(bench).notes[0]


def test_unexpected_acknowledgements_are_noted() -> None:
    bench = Bench(status_return="read_only")
    set_register(bench, "response_status_level", 1)
    assert "it answers writes (response level 1)" in identity_of(bench).notes[0]


@pytest.mark.parametrize("family", ["sts", "sms", "sms_cl", "scs"])
@pytest.mark.parametrize(("configured", "level"), [("all", 0), ("read_only", 1)])
def test_the_servos_own_response_level_counts(family: str, configured: str, level: int) -> None:
    """Whatever the config says of it: no write waits for an acknowledgement that never comes, and none comes unasked."""
    servos = {name: {"id": number, "model": family} for number, name in enumerate("ab", 1)}
    bench = Bench(servos, status_return=configured)
    for device in bench.devices.values():
        device.memory.store(device.memory.registers["response_status_level"], level)
    bench.enable()
    assert bench.move({"a": 1.0}) == {"a": Outcome.ACKED if level else Outcome.SENT}
    assert bench.move({"a": 2.0, "b": 2.0}, confirm=True) == {"a": Outcome.ACKED, "b": Outcome.ACKED}
    assert bench.run(bench.driver.disable("a")).confirmed


def test_mode_torque_and_limits() -> None:
    bench = Bench()
    set_register(bench, "mode", 1)
    set_register(bench, "torque_enable", 1)
    set_register(bench, "min_angle_limit", 1024)
    set_register(bench, "max_angle_limit", 3072)
    identity = identity_of(bench)
    assert (identity.mode, identity.energised, identity.limits) == ("velocity", True, (-90.0, 90.0))


def test_an_scs_is_a_motor_without_limits() -> None:
    bench = Bench({"a": {"id": 1, "model": "scs"}})
    assert identity_of(bench).mode == "position"
    set_register(bench, "min_angle_limit", 0)
    set_register(bench, "max_angle_limit", 0)
    identity = identity_of(bench)
    assert (identity.mode, identity.limits) == ("motor", None)
