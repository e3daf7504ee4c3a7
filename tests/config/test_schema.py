"""The JSON Schema for editors: it accepts and refuses the same configs as the loader, as far as a schema can."""

from __future__ import annotations

from pathlib import Path

import pytest

from servobus.config.schema import config_schema
from servobus.documents import reader
from servobus.protocols.sms.options import SmsBus
from tests.config.mistakes import MISTAKES
from tests.json_schema import accepts

EXAMPLES = Path(__file__).parents[2] / "config"


def in_schema(data: object) -> bool:
    schema = config_schema()
    return accepts(schema, data, schema["$defs"])


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.yaml")), ids=lambda path: path.stem)
def test_the_schema_accepts_the_examples(path: Path) -> None:
    assert in_schema(reader.read(path).data)


@pytest.mark.parametrize(
    "name",
    [
        "unknown key",
        "missing key",
        "id out of range",
        "boolean for a number",
        "unknown protocol",
        "wrong version",
        "rate of zero",
        "too many limits",
        "limits that are no list",
        "number as a port",
    ],
)
def test_the_schema_refuses_what_an_editor_can_see(name: str) -> None:
    assert not in_schema(reader.parse(MISTAKES[name].text, "rig.yaml").data)


def test_the_schema_explains_the_keys() -> None:
    definitions = config_schema()["$defs"]
    assert definitions["SmsServo"]["properties"]["zero"]["description"].startswith("Raw position of the servo where")
    assert definitions["SmsBus"]["properties"]["sync_max_bytes"]["description"].startswith("Longest SYNC WRITE frame")


def test_the_schema_has_every_key() -> None:
    schema = config_schema()
    assert schema["properties"]["version"]["const"] == 1
    definitions = schema["$defs"]
    assert set(SmsBus.model_fields) == set(definitions["SmsBus"]["properties"])
    assert definitions["SmsBus"]["additionalProperties"] is False
    assert "limits" in definitions["SmsServo"]["properties"]
