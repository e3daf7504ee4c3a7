"""The YAML reader: scalars, lines and columns, and everything that it refuses. Attacks: tests/config/test_attacks.py."""

from __future__ import annotations

from pathlib import Path

import pytest

from servobus.documents.reader import MAX_BYTES, MAX_DEPTH, MAX_NODES, clip, parse, read
from servobus.errors import ConfigError


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1", 1),
        ("-7", -7),
        ("0x25", 37),
        ("0o17", 15),
        ("1.5", 1.5),
        ("1e3", 1000.0),
        (".5", 0.5),
        ("true", True),
        ("False", False),
        ("null", None),
        ("~", None),
        ("", None),
        ("yes", "yes"),
        ("on", "on"),
        ("'1'", "1"),
        ('"a\\nb"', "a\nb"),
        ("1_000", "1_000"),
        ("12:30", "12:30"),
    ],
)
def test_scalars(text: str, value: object) -> None:
    parsed = parse(f"a: {text}", "f").data["a"]
    assert (parsed, type(parsed)) == (value, type(value))


def test_lines_and_columns() -> None:
    document = parse("a:\n  b: [1, 2]\n  c: {d: x}\n", "f.yaml")
    assert document.data == {"a": {"b": [1, 2], "c": {"d": "x"}}}
    assert document.mark(("a",), key=True) == (1, 1)
    assert document.mark(("a", "b")) == (2, 6)
    assert document.mark(("a", "b", 1)) == (2, 10)
    assert document.mark(("a", "c", "d")) == (3, 10)
    assert document.mark(("a", "c", "nowhere")) == (3, 3), "the nearest key above"
    assert document.mark(("nowhere",)) == (1, 1)


def test_windows_line_ends_and_a_first_marker() -> None:
    assert parse(b"# c\r\n---\r\na: 1\r\n", "f").data == {"a": 1}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("%YAML 1.2\n---\na: 1", "1:1: found a YAML directive"),
        ("a: 1\n---\nb: 2", "2:1: found ---"),
        ("a: 1\n...\nb: 2", "2:1: found ..."),
        ("a: [1", "this is not YAML"),
        ("a: 'x", "this is not YAML"),
        ('a: "\\xZZ"', "not YAML"),
        ('a: "\\U00110000"', "check escapes in double quotes"),
        ('a: "\\uD800"', "in this text found the control character U+D800"),
        ("? [1]\n: 2", "found a list or a mapping as a key"),
        ("<<: {a: 1}", "found a merge key"),
        ("1.5: x", "found 1.5 as a key"),
        ("true: x", "found true as a key"),
        ("~: x", "found ~ as a key"),
        ('a: "\\0"', "in this text found the control character U+0000"),
        ("a: !!str 1", "found a tag"),
        ("a: &x 1", "found an anchor"),
        ("a: 01", "leading zero"),
        ("a: 9223372036854775808", "beyond 64 bits"),
        ("a: -.inf", "write a finite number"),
        ("a: 1e999", "write a finite number"),
        ("a: \x1b[31m", "control character U+001B"),
        ("a: \u202e", "U+202E"),
    ],
)
def test_what_is_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse(text, "f")
    assert message in str(caught.value)
    assert str(caught.value).startswith("f:")


def test_sizes_at_their_edges() -> None:
    largest = "a: " + "x" * (MAX_BYTES - 3)
    assert len(parse(largest, "f").data["a"]) == MAX_BYTES - 3
    for more in (largest + "x", (largest + "x").encode(), "a: " + "ä" * MAX_BYTES):
        with pytest.raises(ConfigError, match="more than 65536 bytes"):
            parse(more, "f")
    nested = "[" * (MAX_DEPTH - 1) + "]" * (MAX_DEPTH - 1)
    assert parse(f"a: {nested}", "f").data
    with pytest.raises(ConfigError, match="levels of nesting"):
        parse(f"a: [{nested}]", "f")
    blocks = "\n".join(" " * depth + "a:" for depth in range(MAX_DEPTH + 2))
    with pytest.raises(ConfigError, match="levels of nesting"):
        parse(blocks, "f")
    assert len(parse("\n".join(f"k{n}: 1" for n in range(MAX_NODES // 2 - 1)), "f").data) == MAX_NODES // 2 - 1
    with pytest.raises(ConfigError, match="keys and values"):
        parse("\n".join(f"k{n}: 1" for n in range(MAX_NODES // 2 + 1)), "f")


def test_the_largest_integer() -> None:
    assert parse("a: 9223372036854775807", "f").data["a"] == 2**63 - 1


def test_files(tmp_path: Path) -> None:
    path = tmp_path / "f.yaml"
    path.write_text("a: 1")
    assert read(path).data == {"a": 1}
    with pytest.raises(ConfigError, match="there is no such file"):
        read(tmp_path / "g.yaml")
    with pytest.raises(ConfigError, match="this is a directory"):
        read(tmp_path)
    with pytest.raises(ConfigError, match="cannot be read"):
        read("a\0b")


def test_clipped_text_is_short_and_printable() -> None:
    assert clip("abc", 3) == "abc"
    assert clip("abcd", 3) == "..."
    assert clip("x" * 100, 10) == "xxxxxxx..."
    assert clip("a\x1b\n") == "a??"
