"""The JSON Schema of a config, for editors: made from the options of every protocol."""

from __future__ import annotations

from typing import Annotated, Any, Union

from pydantic import Field, TypeAdapter

from servobus.config.access import AccessOptions, DoorOptions
from servobus.config.loader import REQUIRED, VERSION
from servobus.protocols.options import Name
from servobus.protocols.registry import PROTOCOLS


def config_schema() -> dict[str, Any]:
    """The schema as data. Two servos with one id, or limits beyond a model, are found by `load_config` alone."""
    options = tuple(definition.options for definition in PROTOCOLS.values())
    bus: Any = Annotated[Union[options], Field(discriminator="protocol")] if len(options) > 1 else options[0]  # noqa: UP007
    definitions: dict[str, Any] = {}

    def schema(kind: Any) -> dict[str, Any]:
        made = TypeAdapter(kind).json_schema(ref_template="#/$defs/{model}")
        definitions.update(made.pop("$defs", {}))
        return made

    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "servobus config",
        "type": "object",
        "properties": {
            "version": {"const": VERSION, "description": "Of this format."},
            "buses": {**schema(dict[Name, bus]), "minProperties": 1, "description": "Lines by name; each has one owner."},
            "access": schema(AccessOptions),
            "door": schema(DoorOptions),
        },
        "required": list(REQUIRED),
        "additionalProperties": False,
        "$defs": definitions,
    }
