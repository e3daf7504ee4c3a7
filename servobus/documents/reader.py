"""Reads a safe subset of YAML within limits, and keeps the line and column of every value.

The whole project reads YAML with this module, so each problem can name `file:line:column`. The text may come from an attacker:

- A linear scan of the text runs before the parser, because the length of a text does not bound the parser's time and memory.
- The parser's events are counted as they come, and the first one that a config cannot contain ends the reading.
- An error repeats at most a few characters of the text.

Scalars follow the core schema of YAML 1.2 (`on` and `yes` are text). `010` is refused, because YAML 1.1 reads it as eight.
"""

from __future__ import annotations

import math
import re
from collections.abc import Generator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn, TypeAlias

from ruamel.yaml import YAML, events
from ruamel.yaml.error import MarkedYAMLError, YAMLError

from servobus.errors import ConfigError

MAX_BYTES = 64 * 1024
MAX_DEPTH = 16
MAX_NODES = 5000  # keys and values. The parser takes about 15 us for each, so this limit bounds its time.
MAX_INTEGER = (1 << 63) - 1
MAX_SHOWN = 60  # characters of the text that an error may repeat

KeyPath: TypeAlias = tuple[str | int, ...]
Mark: TypeAlias = tuple[int, int]  # line and column, counted from 1

FORBIDDEN = re.compile(r"[^\n\x20-\x7e\xa0-\u2027\u202f-\u2065\u206a-\ud7ff\ue000-\ufefe\uff00-\ufffd\U00010000-\U0010ffff]")
"""Tabs, byte-order marks, control characters, surrogates, and characters that change the direction of writing."""
FORBIDDEN_HINTS = {"\t": "found a tab; use spaces", "\ufeff": "found a byte-order mark; save the file as UTF-8 without one"}
MARKER = re.compile(r"^(?:---(?=[ \n]|\Z)|\.\.\.(?=[ \n]|\Z)|%)", re.MULTILINE)
BEFORE_DOCUMENT = re.compile(r"(?:[ ]*(?:#[^\n]*)?\n)*")
BRACKET = re.compile(r"[\[\]{}]")
TOO_DEEP = f"found more than {MAX_DEPTH} levels of nesting; flatten it"

UNREADABLE: dict[type[Exception], str] = {
    FileNotFoundError: "there is no such file; check the path",
    IsADirectoryError: "this is a directory; name a YAML file in it",
    PermissionError: "this user may not read it; check its owner and mode",
}
CONSTANTS = dict.fromkeys(("", "~", "null", "Null", "NULL"), None) | {
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
}
INTEGER = re.compile(r"[-+]?[0-9]+|0x[0-9a-fA-F]+|0o[0-7]+")
LEADING_ZERO = re.compile(r"[-+]?0[0-9]+")
FLOAT = re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?")
NOT_FINITE = re.compile(r"[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)")


@dataclass(frozen=True, slots=True)
class Document:
    """The data of a YAML text, and the line and column of each part of it."""

    data: Any
    name: str
    marks: dict[KeyPath, tuple[Mark, Mark]] = field(repr=False)
    """Path -> the starts of its key and of its value; the two are equal for an item of a list."""

    def mark(self, path: KeyPath, *, key: bool = False) -> Mark:
        """The start of a value, or of its key. Where the path does not exist, the start of the key nearest above it."""
        while path not in self.marks:
            path, key = path[:-1], True
        return self.marks[path][0 if key else 1]


def read(path: Path | str) -> Document:
    """Read a file. Raises ConfigError, also where the file cannot be opened."""
    name = clip(str(path), 200)
    try:
        with open(path, "rb") as file:
            data = file.read(MAX_BYTES + 1)
    except (OSError, ValueError) as error:
        advice = next((text for kind, text in UNREADABLE.items() if isinstance(error, kind)), "cannot be read; check the path")
        raise ConfigError(f"{name}: {advice}") from None
    return parse(data, name)


def parse(text: str | bytes, name: str) -> Document:
    """Read a text; messages call it `name`. Raises ConfigError with `name:line:column`, the finding and the next step."""
    name = clip(name, 200)
    text = _decode(text, name)
    _scan(text, name)
    with closing(YAML(typ="safe", pure=True).parse(text)) as parser:
        return _Builder(name, parser).document()


def clip(text: str, length: int = MAX_SHOWN) -> str:
    """The text cut to a length, with unprintable characters replaced, for a message."""
    text = "".join(char if char.isprintable() else "?" for char in text[: length + 1])
    return text if len(text) <= length else text[: length - 3] + "..."


def _fail(name: str, mark: Mark, message: str) -> NoReturn:
    raise ConfigError(f"{name}:{mark[0]}:{mark[1]}: {message}")


def _mark_at(text: str, index: int) -> Mark:
    return text.count("\n", 0, index) + 1, index - (text.rfind("\n", 0, index) + 1) + 1


def _start(event: events.Event) -> Mark:
    return event.start_mark.line + 1, event.start_mark.column + 1


# The linear scan


def _decode(text: str | bytes, name: str) -> str:
    """Returns text of bounded size, with Unix line ends."""
    if len(text) > MAX_BYTES or (isinstance(text, str) and len(text.encode(errors="surrogatepass")) > MAX_BYTES):
        _fail(name, (1, 1), f"found more than {MAX_BYTES} bytes; split the file, a config needs a few thousand")
    if isinstance(text, str):
        return text.replace("\r\n", "\n")
    try:
        return text.decode().replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        valid = text[: error.start].decode()
        message = f"found byte 0x{text[error.start]:02X}, which is not UTF-8; save the file as UTF-8"
        _fail(name, _mark_at(valid, len(valid)), message)


def _scan(text: str, name: str) -> None:
    """Refuses characters, directives, documents and nesting that the text alone shows."""
    if match := FORBIDDEN.search(text):
        _fail(name, _mark_at(text, match.start()), _forbidden(match[0]))
    start = BEFORE_DOCUMENT.match(text)
    for marker in MARKER.finditer(text):
        mark = _mark_at(text, marker.start())
        if marker[0] == "%":
            _fail(name, mark, "found a YAML directive (%); take the line out")
        if marker[0] == "..." or (start and marker.start() != start.end()):
            _fail(name, mark, f"found {marker[0]}, the border of a second document; put each in a file of its own")
    _scan_brackets(text, name)


def _forbidden(char: str) -> str:
    return FORBIDDEN_HINTS.get(char) or f"found the control character U+{ord(char):04X}; take it out"


def _scan_brackets(text: str, name: str) -> None:
    """Refuses deep nesting of brackets, because the parser takes quadratic time for it.

    Brackets inside quotes count too: no config leaves seventeen of them open. `_Builder` counts indented nesting.
    """
    depth = 0
    for bracket in BRACKET.finditer(text):
        depth = depth + 1 if bracket[0] in "[{" else max(0, depth - 1)
        if depth > MAX_DEPTH:
            _fail(name, _mark_at(text, bracket.start()), TOO_DEEP)


# The parser's events become data


class _Builder:
    """Makes data from the parser's events, and refuses the first event that a config cannot contain."""

    def __init__(self, name: str, parser: Generator[Any, None, None]) -> None:
        self.name = name
        self.parser = parser
        self.marks: dict[KeyPath, tuple[Mark, Mark]] = {}
        self.nodes = 0
        self.last: Mark = (1, 1)

    def document(self) -> Document:
        self.marks[()] = ((1, 1), (1, 1))
        data = None
        while (event := self._next()) is not None:
            if isinstance(event, events.NodeEvent):
                data = self._node(event, (), 1)
        return Document(data, self.name, self.marks)

    def _next(self) -> events.Event | None:
        """The next event. Raises ConfigError for an error of the parser."""
        try:
            event: events.Event | None = next(self.parser, None)
        except MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            start = (mark.line + 1, mark.column + 1) if mark else self.last
            problem = clip(str(error.problem or error.context), 100)
            _fail(self.name, start, f"this is not YAML: {problem}; check colons, quotes, brackets and indentation here")
        except (YAMLError, ValueError, OverflowError):
            _fail(self.name, self.last, "the text after this point is not YAML; check escapes in double quotes")
        if event is not None:
            self.last = _start(event)
        return event

    def _refuse(self, event: events.Event, message: str) -> NoReturn:
        _fail(self.name, _start(event), message)

    def _node(self, event: events.Event, path: KeyPath, depth: int) -> Any:
        self._check(event, depth)
        if isinstance(event, events.ScalarEvent):
            return self._scalar(event)
        if isinstance(event, events.MappingStartEvent):
            return self._mapping(path, depth)
        return self._sequence(path, depth)

    def _check(self, event: events.Event, depth: int) -> None:
        self.nodes += 1
        if self.nodes > MAX_NODES:
            self._refuse(event, f"found more than {MAX_NODES} keys and values; split the file")
        if isinstance(event, events.AliasEvent):
            self._refuse(event, "found an alias (*name); write the value out")
        assert isinstance(event, (events.ScalarEvent, events.CollectionStartEvent)), "there are no other nodes"
        if event.anchor is not None:
            self._refuse(event, "found an anchor (&name); take it out and write the value where it is needed")
        if event.tag is not None:
            self._refuse(event, "found a tag (!name); take it out, a value shows its type itself")
        if isinstance(event, events.CollectionStartEvent) and depth > MAX_DEPTH:
            self._refuse(event, TOO_DEEP)

    def _sequence(self, path: KeyPath, depth: int) -> list[Any]:
        items: list[Any] = []
        while (event := self._next()) is not None and not isinstance(event, events.SequenceEndEvent):
            here = (*path, len(items))
            self.marks[here] = (_start(event), _start(event))
            items.append(self._node(event, here, depth + 1))
        return items

    def _mapping(self, path: KeyPath, depth: int) -> dict[str | int, Any]:
        data: dict[str | int, Any] = {}
        while (event := self._next()) is not None and not isinstance(event, events.MappingEndEvent):
            self._check(event, depth)
            key = self._key(event)
            here = (*path, key)
            if key in data:
                first = self.marks[here][0][0]
                self._refuse(event, f"found the key {clip(str(key))} again (first on line {first}); keep one of them")
            value = self._next()
            assert value is not None, "a key's event is followed by its value's"
            self.marks[here] = (_start(event), _start(value))
            data[key] = self._node(value, here, depth + 1)
        return data

    def _key(self, event: events.Event) -> str | int:
        if not isinstance(event, events.ScalarEvent):
            self._refuse(event, "found a list or a mapping as a key; a key is a word or an integer")
        if event.style is None and event.value == "<<":
            self._refuse(event, "found a merge key (<<); write the keys out")
        key = self._scalar(event)
        if isinstance(key, bool) or not isinstance(key, (str, int)):
            self._refuse(event, f"found {clip(event.value) or 'nothing'} as a key; use a word or an integer, or put it in quotes")
        return key

    def _scalar(self, event: events.ScalarEvent) -> Any:
        text: str = event.value
        if event.style is not None:
            if match := FORBIDDEN.search(text):
                self._refuse(event, f"in this text {_forbidden(match[0])}")
            return text
        if text in CONSTANTS:
            return CONSTANTS[text]
        if INTEGER.fullmatch(text):
            return self._integer(event, text)
        if NOT_FINITE.fullmatch(text) or (FLOAT.fullmatch(text) and not math.isfinite(float(text))):
            self._refuse(event, f"found {clip(text)}; write a finite number, or put it in quotes if it is text")
        return float(text) if FLOAT.fullmatch(text) else text

    def _integer(self, event: events.Event, text: str) -> int:
        if LEADING_ZERO.fullmatch(text):
            self._refuse(event, f"found the leading zero of {clip(text)}; take it out, or put it in quotes if it is text")
        number = int(text, 0) if len(text) <= 25 else MAX_INTEGER + 1
        if abs(number) > MAX_INTEGER:
            self._refuse(event, "found an integer beyond 64 bits; write a smaller one, or put it in quotes if it is text")
        return number
