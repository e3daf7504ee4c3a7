"""Hostile and damaged configs: each is refused with a short ConfigError, and with nothing else."""

from __future__ import annotations

import json
import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servobus.config.loader import Config, parse_config
from servobus.documents import reader
from servobus.errors import ConfigError
from servobus.protocols.sms.options import SmsBus, SmsServo
from tests.config.mistakes import GOOD


def problem(text: str | bytes) -> str:
    with pytest.raises(ConfigError) as caught:
        parse_config(text, "rig.yaml")
    return str(caught.value)


BOMB = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{b}: &{b} [{','.join(['*' + a] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
ATTACKS = {
    "alias bomb": BOMB,
    "self alias": "a: &a [*a]\n",
    "deep flow": "a: " + "[" * 2000 + "]" * 2000,
    "deep block": "\n".join(" " * depth + "a:" for depth in range(300)),
    "10 MB scalar": "a: " + "x" * 10_000_000,
    "object tag": "!!python/object/apply:os.system ['true']",
    "merge key": "a: &a {x: 1}\nb: {<<: *a}\n",
    "octal id": GOOD.replace("id: 2", "id: 010"),
    "NaN": GOOD.replace("id: 2", "id: .NaN"),
    "tab": GOOD.replace("    port", "\tport"),
    "byte-order mark": "\ufeff" + GOOD,
    "two documents": GOOD + "---\n" + GOOD,
    "NUL": GOOD.replace("arm", "a\0m"),
    "long key": GOOD.replace("arm:", "a" * 60_000 + ":"),
    "huge integer": GOOD.replace("id: 2", "id: " + "9" * 5000),
    "not UTF-8": b"version: \xff\xfe",
    "many keys": "\n".join(f"k{number}: 1" for number in range(8000)),
}


@pytest.mark.parametrize("text", ATTACKS.values(), ids=ATTACKS)
def test_an_attack_is_refused_with_a_short_message(text: str | bytes) -> None:
    message = problem(text)
    assert re.match(r"rig\.yaml:\d+:\d+: ", message)
    assert len(message) < 2048
    assert "x" * 100 not in message


LONG = "y" * 3000


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ('"sim:"', f'"{LONG}"'),
        ('"sim:"', f'"tcp://{LONG}"'),
        ('"sim:"', f'"sim:?{LONG}"'),
        ('"sim:"', f'"tcp://{LONG[:240]}"'),
        ('"sim:"', f'"sim:?{LONG[:240]}"'),
        ("protocol: sms", f"protocol: {LONG}"),
        ("id: 2, model: sts", f"id: 2, model: {LONG}"),
        ("id: 2,", f"id: {LONG},"),
        ("id: 2,", f"id: 2, unit: {LONG},"),
        ("id: 2,", f"id: 2, {LONG}: 1,"),
        ("id: 2,", f"id: 2, limits: [{LONG}, 3],"),
        ("id: 2,", f"id: 2, limits: [{'1, ' * 1000}],"),
        ("elbow:", f"{LONG}:"),
        ("arm:", f"{LONG}:"),
        ("version: 1", f"version: {LONG}"),
        ("version: 1", f"{LONG}: 1"),
    ],
)
def test_long_input_is_not_repeated(before: str, after: str) -> None:
    message = problem(GOOD.replace(before, after))
    assert len(message) < 500
    assert LONG[:70] not in message


@settings(max_examples=60, deadline=None)
@given(st.text(max_size=200) | st.binary(max_size=200))
def test_any_text_gives_a_config_or_a_config_error(text: str | bytes) -> None:
    try:
        assert isinstance(parse_config(text, "rig.yaml"), Config)
    except ConfigError as error:
        assert str(error).startswith("rig.yaml:")  # noqa: PT017 - either end is right


@settings(max_examples=60, deadline=None)
@given(st.integers(0, len(GOOD) - 1), st.text(max_size=3))
def test_a_damaged_config_gives_a_config_or_a_config_error(at: int, insert: str) -> None:
    try:
        parse_config(GOOD[:at] + insert + GOOD[at + 1 :], "rig.yaml")
    except ConfigError as error:
        assert len(str(error)) < 4096  # noqa: PT017 - either end is right


TEXTS = st.sampled_from(["sim:", "tcp://a:1", "tcp://[::1", "a://b", "sts", "/x.yaml", "park", "sms", "deg"])
LEAVES = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=10) | TEXTS
KEYS = st.sampled_from([*SmsBus.model_fields, *SmsServo.model_fields])
VALUES = st.recursive(LEAVES, lambda part: st.lists(part, max_size=3) | st.dictionaries(KEYS, part, max_size=3), max_leaves=8)


@settings(max_examples=60, deadline=None)
@given(KEYS, VALUES, st.sampled_from([(), ("buses",), ("buses", "arm"), ("buses", "arm", "servos", "elbow")]))
def test_any_value_of_a_key_gives_a_config_or_a_config_error(key: str, value: object, path: tuple[str, ...]) -> None:
    data = reader.parse(GOOD, "rig.yaml").data
    part = data
    for step in path:
        part = part[step]
    part[key] = value
    try:
        parse_config(json.dumps(data), "rig.yaml")
    except ConfigError as error:
        assert str(error).startswith("rig.yaml:")  # noqa: PT017 - either end is right
        assert len(str(error)) < 4096  # noqa: PT017
