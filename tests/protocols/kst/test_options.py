"""The keys of a KST bus: the defaults are safe, and an impossible value is refused with its reason."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from servobus.errors import ConfigError
from servobus.protocols.kst import codec
from servobus.protocols.kst.codec import BAUD_TABLE, encode
from servobus.protocols.kst.model import FILES, load_models, packaged_model
from servobus.protocols.kst.requests import TURNAROUND, RequestSettings
from tests.protocols.kst.bench import bus_options, changed_model


def refusal(**keys: Any) -> str:
    with pytest.raises(ValidationError) as caught:
        bus_options(**keys)
    return str(caught.value)


def test_the_defaults_are_the_safe_choices() -> None:
    """Each thing that the document leaves open has a key with a safe default."""
    options = bus_options()
    assert (options.baudrate, options.duplex) == (512_000, "half")
    assert options.sdo_order == "auto"
    assert (options.save_reply, options.save_settle_ms, options.id_effective) == ("none", 200.0, "after_reboot")
    assert (options.version_byte, options.echo_check, options.pad_check) == (0xCA, "strict", "strict")
    assert (options.id_range, options.baud_table, options.status_bits, options.min_gap_us) == ((1, 254), BAUD_TABLE, {}, 0.0)
    assert options.servos["pan"].range_deg is None
    assert options.servos["pan"].on_limit == "reject"


@pytest.mark.parametrize("key", ["on_estop", "on_exit", "on_lost_client"])
def test_limp_is_refused_with_the_reason(key: str) -> None:
    assert "no torque command" in refusal(servos={"pan": {"id": 1, key: "limp"}})
    options = bus_options({"pan": {"id": 1, key: "park", "park_pose": 0}})
    assert getattr(options.servos["pan"], key) == "park"


@pytest.mark.parametrize("key", ["acceleration", "torque_limit"])
def test_what_has_no_command_is_refused(key: str) -> None:
    message = refusal(servos={"pan": {"id": 1, key: 5}})
    assert f"servos.pan.{key}" in message
    assert "a KST servo has no command for it" in message
    assert getattr(bus_options({"pan": {"id": 1, key: None}}).servos["pan"], key) is None


@pytest.mark.parametrize(("number", "fits"), [(0, False), (1, True), (254, True), (255, False), (256, False)])
def test_ids_are_1_to_254(number: int, fits: bool) -> None:
    """KST RS422, 2.1: ids are 0x00 to 0xFF, and 0x00 is the broadcast."""
    servos = {"pan": {"id": number}}
    if fits:
        assert bus_options(servos).servos["pan"].id == number
    else:
        assert "id" in refusal(servos=servos)


def test_id_255_is_there_for_those_who_ask() -> None:
    assert bus_options({"pan": {"id": 255}}, id_range=[1, 255]).servos["pan"].id == 255
    assert "outside id_range 2 to 9" in refusal(servos={"pan": {"id": 1}}, id_range=[2, 9])
    assert "id_range: the first must not be above" in refusal(id_range=[9, 2])
    assert "reply_delay_ms: the first must not be above" in refusal(reply_delay_ms=[1, 0.5])
    assert "greater than or equal to 1" in refusal(id_range=[0, 9])


def test_a_rate_the_servos_do_not_have_is_refused() -> None:
    """KST RS422, 3.1: eight baud rates."""
    assert "baudrate: 1000000 is not one of the servos' rates 9600, 19200" in refusal(baudrate=1_000_000)
    assert bus_options(baudrate=1_000_000, baud_table={8: 1_000_000}).baudrate == 1_000_000
    assert bus_options(baudrate=921_600).baudrate == 921_600


@pytest.mark.parametrize(
    "keys",
    [
        {"sdo_order": "mixed"},
        {"duplex": "both"},
        {"save_settle_ms": -1},
        {"status_bits": {16: "x"}},
        {"version_byte": 256},
        {"unknown": 1},
    ],
)
def test_other_values_and_unknown_keys_are_refused(keys: dict[str, Any]) -> None:
    assert next(iter(keys)) in refusal(**keys)


def test_the_codec_follows_the_options() -> None:
    """The version byte and the check of unused data bytes can be changed."""
    options = bus_options(version_byte=0xCB, pad_check="ignore")
    lenient, strict = codec(options), codec()
    for made in (lenient, strict):
        made.receive_data(encode(1, 0x19, b"\1", version=options.version_byte) + encode(1, 0x19, b"\1") + encode(1, 0x19))
    first, second = lenient.next_reply(), strict.next_reply()
    assert first is not None
    assert second is not None
    assert (first.frame[1], lenient.next_reply()) == (0xCB, None)
    assert (second.frame, strict.next_reply()) == (encode(1, 0x19), None)


def test_what_requests_take_from_the_options() -> None:
    settings = RequestSettings.of(
        bus_options(baudrate=9600, min_gap_us=250, save_settle_ms=50, echo_check="off", sdo_order="le", version_byte=1)
    )
    assert (settings.gap, settings.flash_time, settings.strict_echo, settings.version) == (250e-6, 0.05, False, 1)
    assert settings.guard == 14 * 10 / 9600 + TURNAROUND
    assert settings.aborts.learned == "le"
    assert RequestSettings.of(bus_options()).guard == RequestSettings().guard


# Models


def test_the_packaged_model_is_read_once_for_all_servos() -> None:
    models = load_models(bus_options(), Path())
    assert dict(models) == {"kst": packaged_model()}
    assert packaged_model().goal_ranges["position"] == (-900, 900)
    assert packaged_model().goal_ranges["acceleration"] == packaged_model().goal_ranges["torque_limit"] == (0.0, 0.0)


def test_an_own_model_stands_beside_the_config(tmp_path: Path) -> None:
    (tmp_path / "wide.yaml").write_text("extends: kst\nname: wide\nrange: [-920, 920]\n")
    options = bus_options({"pan": {"id": 1, "model": "wide.yaml", "range_deg": [-92, 92], "unit": "rad"}})
    assert load_models(options, tmp_path)["wide.yaml"].range == (-920, 920)


def test_a_file_that_is_not_a_model_is_refused_with_its_line(tmp_path: Path) -> None:
    (tmp_path / "bad.yaml").write_text((FILES.folder / "kst.yaml").read_text().replace("[-900, 900]", "[-960, 900]"))
    with pytest.raises(ConfigError, match=r"bad\.yaml:.*range \[-960, 900\] must be ascending"):
        FILES.read(tmp_path / "bad.yaml")
    (tmp_path / "worse.yaml").write_text(
        (FILES.folder / "kst.yaml").read_text().replace("default_speed: 600 ", "default_speed: -1 ")
    )
    with pytest.raises(ConfigError, match=r"worse\.yaml:9:16: default_speed: found -1; expected greater than 0"):
        FILES.read(tmp_path / "worse.yaml")
    (tmp_path / "other.yaml").write_text("extends: sts\n")
    with pytest.raises(ConfigError, match=r"other\.yaml:1:10: extends: found 'sts'; there are kst"):
        FILES.read(tmp_path / "other.yaml")
    with pytest.raises(ConfigError, match="model 'kts' is not known; there are kst"):
        load_models(bus_options({"pan": {"id": 1, "model": "kts"}}), tmp_path)


def test_a_model_needs_degrees_and_commands() -> None:
    with pytest.raises(ValidationError, match="deg must be there"):
        changed_model(units={"rad": 0.1})
    registers = packaged_model().model_dump()["registers"]
    with pytest.raises(ValidationError, match="status has address 0x11, which is not a command"):
        changed_model(registers={**registers, "status": {"address": 0x11}})


@pytest.mark.parametrize(("ends", "fits"), [([-90, 90], True), ([-90.1, 90], False), ([-90, 90.1], False), ([-10, 10], True)])
def test_a_range_is_no_wider_than_the_model_s(ends: list[float], fits: bool) -> None:
    """KST RS422, 3.5: -90 to +90 degrees."""
    options = bus_options({"pan": {"id": 1, "range_deg": ends}})
    if fits:
        assert load_models(options, Path())
    else:
        with pytest.raises(ConfigError, match=r"servo pan: range_deg .* is wider than the model's -90 to 90"):
            load_models(options, Path())


def test_a_range_that_is_empty_is_refused() -> None:
    assert "range_deg: the first must be below the second" in refusal(servos={"pan": {"id": 1, "range_deg": [5, 5]}})
