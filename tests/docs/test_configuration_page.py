"""The page of the configuration is the one that the models give, and its examples are accepted."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import BaseModel, ValidationError

from servobus.config.loader import KEYS as TOP_LEVEL
from servobus.config.loader import parse_config
from servobus.config.schema import config_schema
from servobus.documents import reader
from servobus.protocols.kst.options import KstServo
from servobus.protocols.options import BusOptions, ServoOptions
from servobus.protocols.registry import PROTOCOLS
from servobus.protocols.roh.options import RohServo
from servobus.protocols.sms.options import SmsBus, SmsServo
from tests.docs.blocks import ROOT
from tests.docs.configuration_page import KEYS, PATH, SECTIONS, SERVOS, own_keys, page

REQUIRED: dict[str, dict[str, Any]] = {
    "BusOptions": {"protocol": "sms", "port": "sim:", "baudrate": 1000000},
    "ServoOptions": {"id": 2, "park_pose": 0},
    "RohServo": {"id": 2, "channel": "index"},
    "TcpOptions": {"port": 7000, "token_file": "t"},
    "TlsOptions": {"certificate": "c", "key": "k"},
}
"""Model -> other keys that a valid section needs."""


def test_the_page_is_up_to_date() -> None:
    assert PATH.read_text() == page(), "run scripts/docs"


@pytest.mark.parametrize("section", SECTIONS, ids=lambda section: section.model.__name__)
def test_every_key_has_a_meaning_a_unit_and_an_example(section: Any) -> None:
    assert list(KEYS[section.model]) == own_keys(section.model)
    for key in own_keys(section.model):
        meaning = section.model.model_fields[key].description
        assert meaning, key
        assert meaning.endswith("."), key


def test_every_model_of_the_schema_is_on_the_page() -> None:
    models = {section.model.__name__ for section in SECTIONS}
    assert models >= set(config_schema()["$defs"])
    assert set(config_schema()["properties"]) == set(TOP_LEVEL)


def examples() -> list[tuple[type[BaseModel], str, str]]:
    return [(model, key, example) for model, keys in KEYS.items() for key, (_, example) in keys.items()]


@pytest.mark.parametrize(("model", "key", "example"), examples(), ids=lambda value: getattr(value, "__name__", str(value)))
def test_an_example_is_accepted(model: type[BaseModel], key: str, example: str) -> None:
    kind: type[BaseModel] = SmsBus if model is BusOptions else SmsServo if model is ServoOptions else model
    required: dict[str, Any] = {}
    if issubclass(model, BusOptions):
        protocol = next((name for name, each in PROTOCOLS.items() if each.options is model), "sms")
        required = {**REQUIRED["BusOptions"], "protocol": protocol}
        if protocol == "kst":
            required["baudrate"] = 512000
    elif issubclass(model, ServoOptions):
        required = REQUIRED["RohServo"] if model is RohServo else {"id": 2} if model is KstServo else REQUIRED["ServoOptions"]
    else:
        required = REQUIRED.get(model.__name__, {})
    kind.model_validate({**required, key: reader.parse(f"key: {example}", "example").data["key"]})


def test_the_first_block_is_a_config() -> None:
    text = PATH.read_text().partition("```yaml\n")[2].partition("```")[0]
    assert list(parse_config(text, "page").names) == ["arm/shoulder", "arm/elbow"]


def test_a_wrong_example_would_be_refused() -> None:
    with pytest.raises(ValidationError):
        SmsServo.model_validate({"id": 2, "gear": "fast"})


def test_the_page_names_files_that_exist() -> None:
    for name in ("config", "docs/kst.md", "docs/hands.md", "docs/daemon.md"):
        assert (ROOT / name).exists(), name


def test_servos_of_each_protocol_are_shown() -> None:
    assert {definition.options for definition in PROTOCOLS.values()} == set(SERVOS)
