"""Configs: what is accepted, and that every mistake is told at its place, quickly and in few words."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servobus.complaints import MOST
from servobus.config import Config, config_schema, load_config, parse_config
from servobus.errors import ConfigError
from servobus.protocols.sms.options import SmsBus
from tests.config_mistakes import GOOD, MISTAKES, Mistake

EXAMPLES = Path(__file__).parent.parent / "config"


def complaint(text: str | bytes) -> str:
    with pytest.raises(ConfigError) as caught:
        parse_config(text, "rig.yaml")
    return str(caught.value)


def test_a_good_config() -> None:
    config = parse_config(GOOD, "rig.yaml")
    arm = config.buses["arm"]
    assert isinstance(arm, SmsBus)
    assert arm.baudrate == 1_000_000
    assert arm.poll.rates() == {"feedback": 50}
    assert list(arm.servos["shoulder"].limits or ()) == [-90, 90]
    assert config.models["arm"]["sts"].name == "sts"
    assert config.names == {"arm/shoulder": ("arm", "shoulder"), "arm/elbow": ("arm", "elbow")}


def test_a_config_cannot_be_changed() -> None:
    config = parse_config(GOOD, "rig.yaml")
    with pytest.raises(ValueError, match="frozen"):
        setattr(config.buses["arm"], "baudrate", 9600)  # noqa: B010 - the type checker would refuse it too
    with pytest.raises(AttributeError):
        config.version = 2  # type: ignore[misc]


@pytest.mark.parametrize("mistake", MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_is_told_at_its_place(mistake: Mistake) -> None:
    told = complaint(mistake.text)
    assert told.startswith(f"rig.yaml:{mistake.line}:{mistake.column}: "), told
    assert mistake.told in told
    assert len(told.splitlines()) == 1, "one mistake, one complaint"


def test_all_mistakes_are_told_in_the_order_of_the_file() -> None:
    text = GOOD.replace("id: 2", "id: 254").replace("feedback: 50", "feedback: -1").replace("1000000", "fast")
    lines = complaint(text).splitlines()
    assert [int(line.split(":")[1]) for line in lines] == [6, 7, 10]


def test_a_file_with_very_many_mistakes_is_not_told_in_full() -> None:
    text = "version: 1\nbuses:\n" + "".join(f"  b{number}: 7\n" for number in range(100))
    lines = complaint(text).splitlines()
    assert len(lines) == MOST + 1
    assert lines[-1] == f"and {100 - MOST} more; correct these first"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "found nothing; a config begins with"),
        ("[]", "a config begins with `version: 1`"),
        ("version: 1", "no buses"),
        ("version: 1\nbuses: {}", "no buses"),
        ("version: 1\nbuses: []", "no buses"),
        ("version: true\nbuses: {}", "found version true"),
        ("version: 1\nbuses:\n  -x: {}", "a name is letters, digits"),
        ("version: 1\nbuses:\n  a b: {}", "a name is letters, digits"),
        ("version: 1\nbuses:\n  x: 7", "found 7; a bus has the keys"),
        ("version: 1\nbuses:\n  x: {}", "found protocol nothing"),
        ("version: 1\nbuses:\n  x: {protocol: [sms]}", "found protocol"),
        ("version: 1\nbusses: {}\nbuses: {}", "busses: unknown key; there are version, buses"),
    ],
)
def test_what_is_no_config(text: str, told: str) -> None:
    assert told in complaint(text)


def test_servos_that_are_no_servos() -> None:
    assert "found no keys here; there are id, model" in complaint(GOOD.replace("{id: 2, model: sts}", "7"))
    assert "servos: found no keys here" in complaint(re.sub(r"servos:(.|\n)*", "servos: 7\n", GOOD))
    assert "found 1 of its values; write 2 or more" in complaint(GOOD.replace("[-90, 90]", "[-90]"))
    assert "letters, digits, . _ -" in complaint(GOOD.replace("elbow:", "'el bow':"))


# What only the whole file shows


def two_buses(first: str, second: str) -> str:
    bus = "  {name}:\n    protocol: sms\n    port: {port}\n    baudrate: 1000000\n"
    return "version: 1\nbuses:\n" + bus.format(name="left", port=first) + bus.format(name="right", port=second)


def test_two_buses_on_one_port() -> None:
    told = complaint(two_buses("/dev/ttyS77", "/dev/ttyS77"))
    assert told.startswith("rig.yaml:9:11: buses.right.port: found the port of bus left again")


def test_two_buses_on_one_port_by_two_names(tmp_path: Path) -> None:
    (tmp_path / "device").touch()
    (tmp_path / "link").symlink_to(tmp_path / "device")
    assert "port of bus left again" in complaint(two_buses(str(tmp_path / "device"), str(tmp_path / "link")))


def test_two_simulated_buses_are_two_lines() -> None:
    assert len(parse_config(two_buses('"sim:"', '"sim:"'), "rig.yaml").buses) == 2


@pytest.mark.parametrize(
    ("key", "greatest", "beyond"), [("torque_limit", "100", "100.1"), ("limits", "[0, 2699.9]", "[0, 2700]")]
)
def test_what_the_model_cannot_do_at_its_edge(key: str, greatest: str, beyond: str) -> None:
    parse_config(GOOD.replace("id: 2,", f"id: 2, {key}: {greatest},"), "rig.yaml")
    assert f"elbow.{key}" in complaint(GOOD.replace("id: 2,", f"id: 2, {key}: {beyond},"))


def test_a_model_that_has_no_acceleration_says_so() -> None:
    text = GOOD.replace("id: 2, model: sts", "id: 2, model: scs, acceleration: 100")
    assert "model scs has none" in complaint(text)


def test_a_model_file_beside_the_config(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("extends: sts\nname: mine\ntitle: Mine\nunits: {turn: 0.000244140625}\n")
    (tmp_path / "rig.yaml").write_text(GOOD.replace("id: 2, model: sts", "id: 2, model: mine.yaml, limits: [-0.5, 0.5]"))
    config = load_config(tmp_path / "rig.yaml")
    assert config.models["arm"]["mine.yaml"].name == "mine"
    (tmp_path / "mine.yaml").write_text("extends: stx\nname: mine\n")
    with pytest.raises(ConfigError, match=r"rig\.yaml:10:29: .*model: .*mine\.yaml:1:10: extends: is none of"):
        load_config(tmp_path / "rig.yaml")
    (tmp_path / "mine.yaml").write_text("extends: sts\nname: mine\ntitle: Mine\nsteps_per_turn: none\n")
    with pytest.raises(ConfigError, match=r"mine\.yaml:4:17: steps_per_turn: found 'none'"):
        load_config(tmp_path / "rig.yaml")


# Attacks

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
def test_an_attack_is_refused_in_few_words(text: str | bytes) -> None:
    told = complaint(text)
    assert re.match(r"rig\.yaml:\d+:\d+: ", told)
    assert len(told) < 2048
    assert "x" * 100 not in told


@settings(max_examples=60, deadline=None)
@given(st.text(max_size=200) | st.binary(max_size=200))
def test_no_text_is_answered_by_anything_but_a_config_or_a_complaint(text: str | bytes) -> None:
    try:
        assert isinstance(parse_config(text, "rig.yaml"), Config)
    except ConfigError as error:
        assert str(error).startswith("rig.yaml:")  # noqa: PT017 - either end is right


@settings(max_examples=60, deadline=None)
@given(st.integers(0, len(GOOD) - 1), st.text(max_size=3))
def test_no_damage_to_a_good_config_is_answered_by_anything_else(at: int, insert: str) -> None:
    try:
        parse_config(GOOD[:at] + insert + GOOD[at + 1 :], "rig.yaml")
    except ConfigError as error:
        assert len(str(error)) < 4096  # noqa: PT017 - either end is right


# Files


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.yaml")), ids=lambda path: path.stem)
def test_the_examples_are_accepted(path: Path) -> None:
    assert load_config(path).names


def test_there_are_examples() -> None:
    assert {path.stem for path in EXAMPLES.glob("*.yaml")} >= {"arm", "rs485", "sim"}


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="there is no such file"):
        load_config(tmp_path / "none.yaml")
    with pytest.raises(ConfigError, match="this is a directory"):
        load_config(tmp_path)


def test_the_schema_knows_every_key() -> None:
    schema = config_schema()
    assert schema["properties"]["version"] == {"const": 1}
    definitions = schema["$defs"]
    assert set(SmsBus.model_fields) == set(definitions["SmsBus"]["properties"])
    assert definitions["SmsBus"]["additionalProperties"] is False
    assert "limits" in definitions["SmsServo"]["properties"]
