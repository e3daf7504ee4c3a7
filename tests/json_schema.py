"""The part of JSON Schema that the config's schema needs: decides whether an editor would accept some data.

A keyword that it does not know is an error, so that no keyword is ignored.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

KINDS: dict[str, tuple[type, ...]] = {
    "null": (type(None),),
    "boolean": (bool,),
    "integer": (int,),
    "number": (int, float),
    "string": (str,),
    "array": (list,),
    "object": (dict,),
}
ANNOTATIONS = {"$schema", "$defs", "title", "description", "default", "discriminator"}
"""Keywords that refuse nothing."""


def accepts(schema: Mapping[str, Any], data: Any, definitions: Mapping[str, Any]) -> bool:
    """Return whether the data fits."""
    return all(keyword in ANNOTATIONS or RULES[keyword](schema, data, definitions) for keyword in schema)


def _kind(schema: Mapping[str, Any], data: Any, definitions: Mapping[str, Any]) -> bool:
    kind = schema["type"]
    return isinstance(data, KINDS[kind]) and (kind == "boolean" or not isinstance(data, bool))


def _properties(schema: Mapping[str, Any], data: Any, definitions: Mapping[str, Any]) -> bool:
    """Known keys, patterns of keys, and whether there may be others."""
    if not isinstance(data, dict):
        return True
    for key, value in data.items():
        fitting = [one for pattern, one in schema.get("patternProperties", {}).items() if re.search(pattern, str(key))]
        if key in schema.get("properties", {}):
            fitting.append(schema["properties"][key])
        if not fitting and schema.get("additionalProperties", True) is False:
            return False
        if not all(accepts(one, value, definitions) for one in fitting):
            return False
    return True


def _items(schema: Mapping[str, Any], data: Any, definitions: Mapping[str, Any]) -> bool:
    return not isinstance(data, list) or all(
        accepts(one, value, definitions) for one, value in zip(schema["prefixItems"], data, strict=False)
    )


def _fitting(schemas: list[Any], data: Any, definitions: Mapping[str, Any]) -> int:
    return sum(accepts(one, data, definitions) for one in schemas)


def _is_number(data: Any) -> bool:
    return isinstance(data, (int, float)) and not isinstance(data, bool)


RULES: dict[str, Callable[[Mapping[str, Any], Any, Mapping[str, Any]], bool]] = {
    "$ref": lambda schema, data, named: accepts(named[schema["$ref"].removeprefix("#/$defs/")], data, named),
    "type": _kind,
    "const": lambda schema, data, named: data == schema["const"] and type(data) is type(schema["const"]),
    "enum": lambda schema, data, named: data in schema["enum"],
    "anyOf": lambda schema, data, named: _fitting(schema["anyOf"], data, named) >= 1,
    "oneOf": lambda schema, data, named: _fitting(schema["oneOf"], data, named) == 1,
    "properties": _properties,
    "patternProperties": _properties,
    "additionalProperties": _properties,
    "required": lambda schema, data, named: not isinstance(data, dict) or set(schema["required"]) <= set(data),
    "minProperties": lambda schema, data, named: not isinstance(data, dict) or len(data) >= schema["minProperties"],
    "prefixItems": _items,
    "items": lambda schema, data, named: (
        not isinstance(data, list) or all(accepts(schema["items"], value, named) for value in data)
    ),
    "minItems": lambda schema, data, named: not isinstance(data, list) or len(data) >= schema["minItems"],
    "maxItems": lambda schema, data, named: not isinstance(data, list) or len(data) <= schema["maxItems"],
    "minimum": lambda schema, data, named: not _is_number(data) or data >= schema["minimum"],
    "maximum": lambda schema, data, named: not _is_number(data) or data <= schema["maximum"],
    "exclusiveMinimum": lambda schema, data, named: not _is_number(data) or data > schema["exclusiveMinimum"],
    "minLength": lambda schema, data, named: not isinstance(data, str) or len(data) >= schema["minLength"],
    "maxLength": lambda schema, data, named: not isinstance(data, str) or len(data) <= schema["maxLength"],
}
