"""The list of problems found in a document, each as `file:line:column: key.path: what was found; what was expected`.

pydantic finds the mistakes, and the document has the line and column of each. All problems of a file are reported at once, in the
order of the file, and none of them repeats more than a few characters of it.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

from pydantic import BaseModel, ValidationError

from servobus.documents.reader import Document, KeyPath, Mark, clip
from servobus.errors import ConfigError

Mistake: TypeAlias = Mapping[str, Any]  # pydantic's description of one mistake: type, loc, msg, input, ctx
MAX_REPORTED = 20  # lines of problems; a file with more mistakes is probably no config at all
WORDING = {
    "Input should be a valid tuple": "expected a list",
    "Input should be ": "expected ",
    "String should have ": "expected ",
    "Value error, ": "",
    "String should match pattern '^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$'": (
        "expected a name of letters, digits, . _ - that begins with a letter or digit"
    ),
}
"""A part of pydantic's message -> our wording."""


class Problems:
    """Collects the problems of one document."""

    def __init__(self, document: Document) -> None:
        self.document = document
        self._problems: dict[tuple[Mark, str], None] = {}

    def add(self, path: KeyPath, message: str, *, key: bool = False) -> None:
        """Add a problem of the value at `path`, or of its key."""
        mark = self.document.mark(path, key=key)
        dotted = ".".join(clip(str(part), 40) for part in path)
        self._problems[mark, f"{dotted}: {message}" if path else message] = None

    def raise_any(self) -> None:
        """Raises ConfigError where there are problems."""
        if not self._problems:
            return
        problems = [f"{self.document.name}:{line}:{column}: {message}" for (line, column), message in sorted(self._problems)]
        lines = "\n".join(problems).splitlines()  # the problems of a model file are several lines
        if len(lines) > MAX_REPORTED:
            lines[MAX_REPORTED:] = [f"and {len(lines) - MAX_REPORTED} more; correct these first"]
        raise ConfigError("\n".join(lines))

    def validated(self, kind: type[BaseModel], data: Any, path: KeyPath) -> Any:
        """The model of a part of the document; None where it does not fit, and then the problems are added."""
        try:
            return kind.model_validate(data)
        except ValidationError as error:
            for mistake in error.errors(include_url=False):
                self._add_mistake(kind, {**mistake}, path)
        return None

    def _add_mistake(self, kind: type[BaseModel], mistake: Mistake, base: KeyPath) -> None:
        loc = tuple(part for part in mistake["loc"] if part != "[key]")
        path = (*base, *loc)
        rule = RULES.get(mistake["type"])
        if rule is not None:
            rule(self, kind, mistake, path)
            return
        message = mistake["msg"]
        for theirs, ours in WORDING.items():
            message = message.replace(theirs, ours)
        self.add(path, f"{_finding(mistake)}{message}", key=_is_section(mistake) or mistake["loc"][-1:] == ("[key]",))

    def _unknown_key(self, kind: type[BaseModel], mistake: Mistake, path: KeyPath) -> None:
        keys = fields_at(kind, mistake["loc"][:-1])
        near = difflib.get_close_matches(str(path[-1]), keys, n=1)
        hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(keys)}"
        self.add(path, f"unknown key; {hint}", key=True)

    def _missing_key(self, kind: type[BaseModel], mistake: Mistake, path: KeyPath) -> None:
        if isinstance(path[-1], int):
            self.add(path[:-1], f"found {path[-1]} of its values; write {path[-1] + 1} or more")
        else:
            self.add(path[:-1], f"the key {path[-1]} is missing; add it", key=True)

    def _not_a_section(self, kind: type[BaseModel], mistake: Mistake, path: KeyPath) -> None:
        keys = ", ".join(fields_at(kind, mistake["loc"]))
        self.add(path, f"found no keys here; there are {keys}" if keys else "found no keys here; write `{key: value}`")

    def _wrong_count(self, kind: type[BaseModel], mistake: Mistake, path: KeyPath) -> None:
        context = mistake["ctx"]
        expected = f"at most {context['max_length']}" if "max_length" in context else f"{context['min_length']} or more"
        self.add(path, f"found {context['actual_length']} here; write {expected}")

    def _not_text(self, kind: type[BaseModel], mistake: Mistake, path: KeyPath) -> None:
        if mistake["loc"][-1] == "[key]":
            self.add(path, f"found {quote(mistake['input'])} as a name; put it in quotes", key=True)
        else:
            self.add(path, f"{_finding(mistake)}expected text; put a number in quotes", key=_is_section(mistake))


RULES: dict[str, Callable[[Problems, type[BaseModel], Mistake, KeyPath], None]] = {
    "extra_forbidden": Problems._unknown_key,
    "missing": Problems._missing_key,
    "model_type": Problems._not_a_section,
    "dict_type": Problems._not_a_section,
    "too_long": Problems._wrong_count,
    "too_short": Problems._wrong_count,
    "string_type": Problems._not_text,
}
"""pydantic's type of mistake -> the method that adds it; any other keeps pydantic's message."""


def valid_subset(kind: type[BaseModel], data: Mapping[Any, Any]) -> Any:
    """The model of the data without its faulty parts, so that the other parts can be checked too; None where that fails."""
    try:
        return kind.model_validate(data)
    except ValidationError as error:
        faulty = {mistake["loc"][:2] for mistake in error.errors(include_url=False, include_input=False)}
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


def _is_section(mistake: Mistake) -> bool:
    return isinstance(mistake["input"], (Mapping, list, tuple))


def _finding(mistake: Mistake) -> str:
    """Quotes the value; of a whole section the line and column are enough."""
    return "" if _is_section(mistake) else f"found {quote(mistake['input'])}; "


def fields_at(kind: type[BaseModel], loc: KeyPath) -> list[str]:
    """The keys of a model at this path; empty where the keys are the user's own."""
    for part in loc:
        field = kind.model_fields.get(str(part))
        if field is not None:
            inner = models_in(field.annotation)
            if not inner:
                return []
            kind = inner[0]
    return list(kind.model_fields)


def models_in(annotation: Any) -> list[type[BaseModel]]:
    """The models inside an annotation such as `dict[str, Servo]` or `Poll | None`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in getattr(annotation, "__args__", ()) for model in models_in(part)]


def quote(value: Any) -> str:
    """A value as YAML writes it, cut to a few characters."""
    if value is None:
        return "nothing"
    return clip(str(value).lower() if isinstance(value, bool) else repr(value) if isinstance(value, str) else str(value))
