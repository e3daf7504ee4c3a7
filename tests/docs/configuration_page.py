"""Writes docs/configuration.md from the options' models: `python -m tests.docs.configuration_page`, which `scripts/docs` runs.

Key, type, default and meaning come from the models. `KEYS` adds a unit and an example to each key; a test compares it with the
models and validates the examples.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from pydantic import BaseModel

from servobus.config.access import AccessOptions, DoorOptions, TcpOptions, TlsOptions
from servobus.protocols.kst.options import KstBus, KstServo
from servobus.protocols.options import BusOptions, FaultOptions, PollRates, ServoOptions
from servobus.protocols.roh.options import RohBus, RohServo, UnitOptions
from servobus.protocols.sms.options import SmsBus, SmsServo
from tests.docs.blocks import ROOT

PATH = ROOT / "docs" / "configuration.md"


class Section(NamedTuple):
    """The keys of one model, under a heading."""

    model: type[BaseModel]
    title: str
    text: str


SECTIONS = (
    Section(BusOptions, "Keys of every bus", "Below `buses: {NAME: ...}`. A line has one bus, and a bus has one line."),
    Section(PollRates, "`poll`", "Servos are read at fixed rates. Without a rate, only `read()` asks the servo."),
    Section(ServoOptions, "Keys of every servo", "Below `servos: {NAME: ...}` of a bus."),
    Section(SmsBus, "FEETECH bus (`protocol: sms`)", "What a FEETECH bus has beside the keys of every bus."),
    Section(SmsServo, "FEETECH servo", "What differs from the keys of every servo. Units: `deg` (default), `rad`, `step`."),
    Section(
        KstBus, "KST bus (`protocol: kst`)", "The KST RS422 document leaves some points open: each is a key. [KST servos](kst.md)"
    ),
    Section(KstServo, "KST servo", "No `limp`, `acceleration` or `torque_limit`: the servo has no command for it."),
    Section(RohBus, "Line of ROH hands (`protocol: roh`)", "A hand is a unit, and its fingers are servos. [ROH hands](hands.md)"),
    Section(RohServo, "Finger of a ROH hand", "No `limp` and no `acceleration`: the hand has no register for it."),
    Section(UnitOptions, "Hand (`units: {ID: ...}` of a line of hands)", "A hand without this section is `auto`."),
    Section(
        FaultOptions,
        "`faults` of a simulated line",
        'For a bus with `port: "sim:"`. Shares are from 0 to 1.',
    ),
    Section(
        AccessOptions,
        "`access`",
        "Roles of the daemon's clients. Without this section, owner and root are admin, others observer.",
    ),
    Section(DoorOptions, "`door`", "Limits of the daemon's clients. [The daemon](daemon.md)"),
    Section(TcpOptions, "`door: {tcp: ...}`", "Off unless the config has it."),
    Section(TlsOptions, "`door: {tcp: {tls: ...}}`", "Needed where other machines connect."),
)
SERVOS = {SmsBus: "{elbow: {id: 2, model: sts}}", KstBus: "{pan: {id: 37}}", RohBus: "{index: {id: 2, channel: index}}"}
STOP = ("", "limp")
SHARE = ("", "0.01")
KEYS: dict[type[BaseModel], dict[str, tuple[str, str]]] = {
    BusOptions: {
        "protocol": ("", "sms"),
        "port": ("", "/dev/serial/by-id/usb-1a86_USB_Serial-if00-port0"),
        "baudrate": ("bit/s", "1000000"),
        "poll": ("", "{feedback: 50, health: 1}"),
        "goal_rate": ("Hz", "50"),
        "echo": ("", "auto"),
        "rs485": ("", "true"),
        "timeout_ms": ("ms", "50"),
        "faults": ("", "{loss: 0.01}"),
        "servos": ("", SERVOS[SmsBus]),
    },
    PollRates: {"feedback": ("Hz", "50"), "health": ("Hz", "1")},
    ServoOptions: {
        "id": ("", "2"),
        "model": ("", "sts"),
        "zero": ("step", "2048"),
        "direction": ("", "-1"),
        "gear": ("", "3"),
        "limits": ("unit", "[-90, 90]"),
        "on_limit": ("", "clamp"),
        "speed": ("unit/s", "60"),
        "max_speed": ("unit/s", "180"),
        "max_step": ("unit", "10"),
        "acceleration": ("unit/s²", "800"),
        "torque_limit": ("%", "40"),
        "ttl": ("s", "0.5"),
        "on_estop": STOP,
        "on_exit": STOP,
        "on_lost_client": STOP,
        "park_pose": ("unit", "-95"),
        "park_timeout": ("s", "8"),
        "unit": ("", "rad"),
        "allow_max_speed": ("", "true"),
    },
    SmsBus: {
        "sync_max_bytes": ("byte", "64"),
        "status_return": ("", "read_only"),
        "on_partial": ("", "go"),
        "servos": ("", SERVOS[SmsBus]),
    },
    SmsServo: {"id": ("", "2"), "model": ("", "sts")},
    KstBus: {
        "baudrate": ("bit/s", "115200"),
        "duplex": ("", "full"),
        "reply_delay_ms": ("ms", "[0, 0.5]"),
        "sdo_order": ("", "be"),
        "save_reply": ("", "optional"),
        "save_settle_ms": ("ms", "500"),
        "id_effective": ("", "immediate"),
        "version_byte": ("", "0xCA"),
        "min_gap_us": ("µs", "200"),
        "status_bits": ("", "{0: overload, 8: overheated}"),
        "echo_check": ("", "off"),
        "pad_check": ("", "ignore"),
        "id_range": ("", "[1, 255]"),
        "baud_table": ("bit/s", "{4: 115200, 6: 512000}"),
        "servos": ("", SERVOS[KstBus]),
    },
    KstServo: {"id": ("", "0x25"), "model": ("", "kst"), "range_deg": ("deg", "[-60, 60]")},
    RohBus: {
        "baudrate": ("bit/s", "115200"),
        "units": ("", "{2: {model: v1}}"),
        "max_read": ("register", "12"),
        "max_write": ("register", "10"),
        "single_write": ("", "single"),
        "turnaround_ms": ("ms", "50"),
        "servos": ("", SERVOS[RohBus]),
    },
    RohServo: {"id": ("", "2"), "channel": ("", "index"), "model": ("", "finger"), "unit": ("", "deg")},
    UnitOptions: {"model": ("", "v1")},
    FaultOptions: {
        "loss": SHARE,
        "chop": ("", "bytes"),
        "late": SHARE,
        "delay_ms": ("ms", "20"),
        **dict.fromkeys(("duplicate", "truncate", "drop_byte", "insert_byte", "flip", "wrong_id", "noise", "echo"), SHARE),
        "seed": ("", "7"),
    },
    AccessOptions: {"admin": ("", "[root]"), "operator": ("", "['@root']")},
    DoorOptions: {
        "tcp": ("", "{port: 7000, token_file: /etc/servobus/token}"),
        "clients": ("", "100"),
        "clients_per_user": ("", "16"),
        "rate": ("1/s", "200"),
        "lease_ms": ("ms", "1000"),
    },
    TcpOptions: {
        "host": ("", "127.0.0.1"),
        "port": ("", "7000"),
        "token_file": ("", "/etc/servobus/token"),
        "role": ("", "observer"),
        "tls": ("", "{certificate: /etc/servobus/cert.pem, key: /etc/servobus/key.pem}"),
    },
    TlsOptions: {"certificate": ("", "/etc/servobus/cert.pem"), "key": ("", "/etc/servobus/key.pem")},
}
"""Model -> key -> unit and example. "unit" is the servo's own unit."""

HEAD = """\
# Configuration

`scripts/docs` writes this page from the models that validate a config: edit their docstrings.

A config is one YAML file with the buses of a robot and their servos. `servobus check FILE` validates it and prints the load of
each line, `servobus schema` prints a JSON Schema for editors, and `servobus scan --yaml` writes a first config. Commands take it
from `-c FILE`, else from `SERVOBUS_CONFIG`, else from `./servobus.yaml`. [config/](../config) has an example for each kind of
robot.

```yaml
version: 1
buses:
  arm:
    protocol: sms
    port: /dev/serial/by-id/usb-1a86_USB_Serial-if00-port0
    baudrate: 1000000
    poll: {feedback: 50, health: 1}
    servos:
      shoulder: {id: 1, model: sts, limits: [-90, 90], max_speed: 180}
      elbow: {id: 2, model: sts, zero: 2048, direction: -1}
```

Every problem is reported with file, line and column, the path of the key and what was expected. Unknown keys, duplicate keys,
duplicate ids, aliases, anchors, tags, tabs, numbers that are not finite, and a second document are refused. A file has at most
64 KiB, 5000 keys and values, and 16 levels. A name of a bus or a servo is letters, digits, `.`, `_` and `-`, and begins with a
letter or a digit.

In the tables, *unit* is the servo's own unit: degrees unless `unit` says otherwise, percent for the finger of a hand. An empty
default means that the key may be omitted; its meaning says what happens then.

## Top level

| key | type | default | example | meaning |
|---|---|---|---|---|
| `version` | 1 | required | `1` | Version of this format. |
| `buses` | mapping | required | | The buses by name, at least one. |
| `access` | mapping | | `{admin: [root]}` | Roles of the daemon's clients, see [access](#access). |
| `door` | mapping | | `{clients: 100}` | Limits of the daemon's clients, see [door](#door). |
"""
TABLE = "| key | unit | type | default | example | meaning |\n|---|---|---|---|---|---|\n"


def page() -> str:
    return HEAD + "".join(map(_section, SECTIONS))


def own_keys(model: type[BaseModel]) -> list[str]:
    """The keys that a model defines itself. The title of a bus has its `protocol`."""
    skipped = {"protocol"} if issubclass(model, BusOptions) and model is not BusOptions else set()
    return [name for name in vars(model)["__annotations__"] if name in model.model_fields and name not in skipped]


def _section(section: Section) -> str:
    return f"\n## {section.title}\n\n{section.text}\n\n{TABLE}" + "".join(_rows(section.model))


def _rows(model: type[BaseModel]) -> Iterator[str]:
    whole = model.model_json_schema()
    for key in own_keys(model):
        schema = whole["properties"][key]
        unit, example = KEYS[model][key]
        meaning = " ".join(schema["description"].split())
        default = "required" if key in whole.get("required", ()) else _default(schema)
        cells = (f"`{key}`", unit, _type(schema), default, f"`{example}`", meaning)
        yield "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"


def _default(schema: Mapping[str, Any]) -> str:
    default = schema.get("default")
    if default is None or default in ([], {}, "") or (isinstance(default, dict) and not any(default.values())):
        return ""
    text = default if isinstance(default, str) else re.sub(r'"|\.0\b', "", json.dumps(default))
    return f"`{text}`"


def _type(schema: Mapping[str, Any]) -> str:
    """A schema in a few words."""
    if "anyOf" in schema:
        (schema,) = (each for each in schema["anyOf"] if each.get("type") != "null")
    if "enum" in schema or "const" in schema:
        values = [f"`{value}`" for value in schema.get("enum", [schema.get("const")])]
        return " or ".join(filter(None, (", ".join(values[:-1]), values[-1])))
    if "prefixItems" in schema:
        return f"list of {schema['maxItems']}: {_type(schema['prefixItems'][0])}"
    if schema.get("pattern", "").startswith("^("):
        return _type({"enum": schema["pattern"][2:-2].split("|")})
    kinds = {"boolean": "`true` or `false`", "string": "text", "array": "list of text", "object": "mapping", None: "mapping"}
    return kinds.get(schema.get("type")) or f"{schema['type']}{_range(schema)}"


def _range(schema: Mapping[str, Any]) -> str:
    low, above, high = schema.get("minimum"), schema.get("exclusiveMinimum"), schema.get("maximum")
    if low is not None and high is not None:
        return f", {low:.9g} to {high:.9g}"
    bounds = {"at least": low, "above": above, "at most": high}
    return "".join(f", {name} {bound:.9g}" for name, bound in bounds.items() if bound is not None)


if __name__ == "__main__":
    PATH.write_text(page())
