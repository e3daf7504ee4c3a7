"""What is wrong in a file, each problem at its place: `file:line:column: key.path: what was found; what was expected`.

pydantic says what does not fit; the YAML document says where that stands. All problems of a file are told at once, the first in
the file first, and none repeats more of the input than a few words.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

from pydantic import BaseModel, ValidationError

from servobus.documents.reader import Document, KeyPath, Place, clip
from servobus.errors import ConfigError

Entry: TypeAlias = Mapping[str, Any]
"""What pydantic says of one mistake: type, loc, msg, input, ctx."""
MOST = 20
"""Problems that are told; a file with more is some other file."""
EXPECTED = {
    "Input should be a valid tuple": "expected a list",
    "Input should be ": "expected ",
    "String should have ": "expected ",
    "Value error, ": "",
    "String should match pattern '^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$'": (
        "expected a name of letters, digits, . _ - that begins with a letter or digit"
    ),
}
"""pydantic's words -> ours."""


class Problems:
    """Collects what is wrong in one document."""

    def __init__(self, document: Document) -> None:
        self.document = document
        self._found: dict[tuple[Place, str], None] = {}

    def add(self, path: KeyPath, message: str, *, key: bool = False) -> None:
        """At a value, or at its key."""
        place = self.document.place(path, key=key)
        self._found[place, f"{dotted(path)}: {message}" if path else message] = None

    def raise_any(self) -> None:
        """Raises ConfigError when there are any."""
        if not self._found:
            return
        told = [f"{self.document.name}:{line}:{column}: {message}" for ((line, column), message) in sorted(self._found)]
        lines = "\n".join(told).splitlines()  # what is wrong in a model file has several
        if len(lines) > MOST:
            lines[MOST:] = [f"and {len(lines) - MOST} more; correct these first"]
        raise ConfigError("\n".join(lines))

    def validated(self, kind: type[BaseModel], data: Any, path: KeyPath) -> Any:
        """The model of this part of the document; None when it does not fit, and then it is said why."""
        try:
            return kind.model_validate(data)
        except ValidationError as error:
            for entry in error.errors(include_url=False):
                self._add_entry(kind, {**entry}, path)
        return None

    def _add_entry(self, kind: type[BaseModel], entry: Entry, base: KeyPath) -> None:
        loc = tuple(part for part in entry["loc"] if part != "[key]")
        path = (*base, *loc)
        rule = RULES.get(entry["type"])
        if rule is not None:
            rule(self, kind, entry, path)
            return
        message = entry["msg"]
        for theirs, ours in EXPECTED.items():
            message = message.replace(theirs, ours)
        self.add(path, f"{_found(entry)}{message}", key=_is_section(entry) or entry["loc"][-1:] == ("[key]",))

    def _unknown_key(self, kind: type[BaseModel], entry: Entry, path: KeyPath) -> None:
        known = fields_at(kind, entry["loc"][:-1])
        near = difflib.get_close_matches(str(path[-1]), known, n=1)
        hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(known)}"
        self.add(path, f"unknown key; {hint}", key=True)

    def _missing_key(self, kind: type[BaseModel], entry: Entry, path: KeyPath) -> None:
        if isinstance(path[-1], int):
            self.add(path[:-1], f"found {path[-1]} of its values; write {path[-1] + 1} or more")
        else:
            self.add(path[:-1], f"the key {path[-1]} is missing; add it", key=True)

    def _no_section(self, kind: type[BaseModel], entry: Entry, path: KeyPath) -> None:
        known = ", ".join(fields_at(kind, entry["loc"]))
        self.add(path, f"found no keys here; there are {known}" if known else "found no keys here; write `{key: value}`")

    def _wrong_number(self, kind: type[BaseModel], entry: Entry, path: KeyPath) -> None:
        found = entry["ctx"]
        wanted = f"at most {found['max_length']}" if "max_length" in found else f"{found['min_length']} or more"
        self.add(path, f"found {found['actual_length']} here; write {wanted}")

    def _no_text(self, kind: type[BaseModel], entry: Entry, path: KeyPath) -> None:
        if entry["loc"][-1] == "[key]":
            self.add(path, f"found {quote(entry['input'])} as a name; put it in quotes", key=True)
        else:
            self.add(path, f"{_found(entry)}expected text; a number stands in quotes", key=_is_section(entry))


RULES: dict[str, Callable[[Problems, type[BaseModel], Entry, KeyPath], None]] = {
    "extra_forbidden": Problems._unknown_key,
    "missing": Problems._missing_key,
    "model_type": Problems._no_section,
    "dict_type": Problems._no_section,
    "too_long": Problems._wrong_number,
    "too_short": Problems._wrong_number,
    "string_type": Problems._no_text,
}


def valid_subset(kind: type[BaseModel], data: Mapping[Any, Any]) -> Any:
    """The model of what is left when everything that does not fit is taken out, so that the rest can be looked at in the same
    go; None when the rest does not stand alone."""
    try:
        return kind.model_validate(data)
    except ValidationError as error:
        faulty = {entry["loc"][:2] for entry in error.errors(include_url=False, include_input=False)}
    rest = dict(data)
    for key, *below in filter(None, faulty):
        if below and isinstance(rest.get(key), Mapping):
            rest[key] = {name: value for name, value in rest[key].items() if name != below[0]}
        else:
            rest.pop(key, None)
    try:
        return kind.model_validate(rest)
    except ValidationError:
        return None


def _is_section(entry: Entry) -> bool:
    return isinstance(entry["input"], (Mapping, list, tuple))


def _found(entry: Entry) -> str:
    """Nothing for a whole section: its place says enough."""
    return "" if _is_section(entry) else f"found {quote(entry['input'])}; "


def fields_at(kind: type[BaseModel], loc: KeyPath) -> list[str]:
    """The keys that are known at this place of a model; none where they are the user's own."""
    for part in loc:
        field = kind.model_fields.get(str(part))
        if field is not None:
            inner = _models_in(field.annotation)
            if not inner:
                return []
            kind = inner[0]
    return list(kind.model_fields)


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    """The models that an annotation holds: `dict[str, Servo]`, `Poll | None`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in getattr(annotation, "__args__", ()) for model in _models_in(part)]


def dotted(path: KeyPath) -> str:
    return ".".join(clip(str(part), 40) for part in path)


def quote(value: Any) -> str:
    """A value as it is written, cut to a few words."""
    if value is None:
        return "nothing"
    return clip(str(value).lower() if isinstance(value, bool) else repr(value) if isinstance(value, str) else str(value))
