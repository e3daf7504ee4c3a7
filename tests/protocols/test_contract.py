"""Every protocol of the registry holds to the contract of protocols."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from servobus.protocols.registry import PROTOCOLS
from tests.protocols.contract import BUSES, CHECKS, Joined


@pytest.mark.parametrize("name", PROTOCOLS)
@pytest.mark.parametrize("check", CHECKS)
def test_contract(name: str, check: Callable[[Joined], None]) -> None:
    check(Joined(PROTOCOLS[name], name, BUSES[name]))


@pytest.mark.parametrize("name", PROTOCOLS)
def test_a_bus_without_servos_is_possible(name: str) -> None:
    definition = PROTOCOLS[name]
    options = definition.options.model_validate({"protocol": name, "port": "sim:", "baudrate": definition.baudrates[0]})
    assert options.protocol == name
    assert len(set(definition.baudrates)) == len(definition.baudrates)
    for codec in (definition.codec(options), definition.codec(None), definition.device_codec(options)):
        codec.receive_data(b"\x00")
        assert codec.next_reply() is None
    assert definition.driver(options, {}).nodes == {}
    assert definition.devices(options, {}) == []
