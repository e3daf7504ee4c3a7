"""Configs: what is accepted, and that every mistake is reported at its line and column, quickly and briefly."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from servobus.config.loader import load_config, parse_config
from servobus.documents.problems import MAX_REPORTED
from servobus.errors import ConfigError
from servobus.protocols.sms.options import SmsBus
from tests.config.mistakes import GOOD, MISTAKES, Mistake

EXAMPLES = Path(__file__).parents[2] / "config"


def problem(text: str | bytes) -> str:
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
def test_a_mistake_is_reported_with_line_and_column(mistake: Mistake) -> None:
    message = problem(mistake.text)
    assert message.startswith(f"rig.yaml:{mistake.line}:{mistake.column}: "), message
    assert mistake.message in message
    assert len(message.splitlines()) == 1, "one mistake, one problem"


def test_mistakes_are_reported_in_the_order_of_the_file() -> None:
    text = GOOD.replace("id: 2", "id: 254").replace("feedback: 50", "feedback: -1").replace("1000000", "fast")
    lines = problem(text).splitlines()
    assert [int(line.split(":")[1]) for line in lines] == [6, 7, 10]


def test_one_mistake_hides_no_other() -> None:
    text = GOOD.replace("poll: {feedback: 50}", "poll: {feedbck: 50}").replace("id: 2,", "id: 1, limits: [0, 99999],")
    text += "      wrist: {id: 3, modle: sts}\n"
    lines = problem(text).splitlines()
    assert [line.split(": ")[1].removeprefix("buses.arm.") for line in lines] == [
        "poll.feedbck",
        "servos.elbow.id",
        "servos.elbow.limits",
        "servos.wrist.modle",
    ]


def test_a_mistake_of_a_bus_hides_no_mistake_of_the_next() -> None:
    text = two_buses("/dev/ttyS77", "/dev/ttyS77").replace("    baudrate", "    baud: 1\n    baudrate", 1)
    message = problem(text)
    assert "rig.yaml:6:5: buses.left.baud: unknown key" in message
    assert "rig.yaml:10:11: buses.right.port: found the port of bus left again" in message


def test_only_the_first_of_many_mistakes_are_reported() -> None:
    text = "version: 1\nbuses:\n" + "".join(f"  b{number}: 7\n" for number in range(100))
    lines = problem(text).splitlines()
    assert len(lines) == MAX_REPORTED + 1
    assert lines[-1] == f"and {100 - MAX_REPORTED} more; correct these first"


@pytest.mark.parametrize(
    ("text", "message"),
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
def test_a_document_that_is_not_a_config(text: str, message: str) -> None:
    assert message in problem(text)


def test_values_that_are_not_servos() -> None:
    assert "found no keys here; there are id, model" in problem(GOOD.replace("{id: 2, model: sts}", "7"))
    assert "servos: found no keys here" in problem(re.sub(r"servos:(.|\n)*", "servos: 7\n", GOOD))
    assert "found 1 of its values; write 2 or more" in problem(GOOD.replace("[-90, 90]", "[-90]"))
    assert "letters, digits, . _ -" in problem(GOOD.replace("elbow:", "'el bow':"))


# What only the whole file shows


def two_buses(first: str, second: str) -> str:
    bus = "  {name}:\n    protocol: sms\n    port: {port}\n    baudrate: 1000000\n"
    return "version: 1\nbuses:\n" + bus.format(name="left", port=first) + bus.format(name="right", port=second)


def test_two_buses_on_one_port() -> None:
    message = problem(two_buses("/dev/ttyS77", "/dev/ttyS77"))
    assert message.startswith("rig.yaml:9:11: buses.right.port: found the port of bus left again")


def test_two_buses_on_one_port_by_two_names(tmp_path: Path) -> None:
    (tmp_path / "device").touch()
    (tmp_path / "link").symlink_to(tmp_path / "device")
    assert "port of bus left again" in problem(two_buses(str(tmp_path / "device"), str(tmp_path / "link")))


def test_two_simulated_buses_are_two_lines() -> None:
    assert len(parse_config(two_buses('"sim:"', '"sim:"'), "rig.yaml").buses) == 2


@pytest.mark.parametrize(("key", "largest", "beyond"), [("torque_limit", "100", "100.1"), ("limits", "[0, 2699.9]", "[0, 2700]")])
def test_the_limits_of_a_model_at_their_edges(key: str, largest: str, beyond: str) -> None:
    parse_config(GOOD.replace("id: 2,", f"id: 2, {key}: {largest},"), "rig.yaml")
    assert f"elbow.{key}" in problem(GOOD.replace("id: 2,", f"id: 2, {key}: {beyond},"))


def test_acceleration_of_a_model_without_it_is_refused() -> None:
    text = GOOD.replace("id: 2, model: sts", "id: 2, model: scs, acceleration: 100")
    assert "model scs has none" in problem(text)


def test_a_model_file_beside_the_config(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("extends: sts\nname: mine\ntitle: Mine\nunits: {turn: 0.000244140625}\n")
    (tmp_path / "rig.yaml").write_text(GOOD.replace("id: 2, model: sts", "id: 2, model: mine.yaml, limits: [-0.5, 0.5]"))
    config = load_config(tmp_path / "rig.yaml")
    assert config.models["arm"]["mine.yaml"].name == "mine"
    (tmp_path / "mine.yaml").write_text("extends: stx\nname: mine\n")
    with pytest.raises(ConfigError, match=r"rig\.yaml:10:29: .*model: .*mine\.yaml:1:10: extends: found 'stx'; there are scs"):
        load_config(tmp_path / "rig.yaml")
    (tmp_path / "mine.yaml").write_text("extends: sts\nname: mine\ntitle: Mine\nsteps_per_turn: none\n")
    with pytest.raises(ConfigError, match=r"mine\.yaml:4:17: steps_per_turn: found 'none'"):
        load_config(tmp_path / "rig.yaml")


def test_mistakes_in_a_model_file_are_reported_once(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("extends: sts\nregisters: {lock: {adress: 5}, id: {size: 3}}\n")
    (tmp_path / "rig.yaml").write_text(GOOD.replace("model: sts", "model: mine.yaml"))
    with pytest.raises(ConfigError) as caught:
        load_config(tmp_path / "rig.yaml")
    first, second, third = str(caught.value).splitlines()
    assert first.endswith("mine.yaml:2:20: registers.lock.adress: unknown key; did you mean address?")
    assert second.endswith("mine.yaml:2:43: registers.id.size: found 3; expected 1, 2 or 4")
    assert third.endswith("rig.yaml:10:29: buses.arm.servos.elbow.model: cannot be used, see shoulder")


def test_a_refused_model_hides_no_other_mistake() -> None:
    text = GOOD.replace("id: 1, model: sts", "id: 1, model: stx").replace("id: 2,", "id: 2, unit: feet,")
    assert [line.split(":")[1] for line in problem(text).splitlines()] == ["9", "10"]


def test_lines_are_counted_when_many_models_are_wrong(tmp_path: Path) -> None:
    keys = ", ".join(f"k{number}: 1" for number in range(30))
    (tmp_path / "mine.yaml").write_text(f"extends: sts\nregisters: {{lock: {{{keys}}}}}\n")
    (tmp_path / "rig.yaml").write_text(GOOD.replace("model: sts", "model: mine.yaml"))
    with pytest.raises(ConfigError) as caught:
        load_config(tmp_path / "rig.yaml")
    assert len(str(caught.value).splitlines()) == MAX_REPORTED + 1


# Files


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.yaml")), ids=lambda path: path.stem)
def test_the_examples_are_accepted(path: Path) -> None:
    assert load_config(path).names


def test_there_are_examples() -> None:
    assert {path.stem for path in EXAMPLES.glob("*.yaml")} >= {"arm", "rs485", "sim"}


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="there is no such file"):
        load_config(tmp_path / "none.yaml")
    with pytest.raises(ConfigError, match="this is a directory"):
        load_config(tmp_path)
