"""FEETECH model files: the packaged ones, and those that stand beside a config and may extend them."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from servobus import yamlfile
from servobus.complaints import Complaints, show
from servobus.errors import ConfigError
from servobus.protocols.sms.model import SmsModel
from servobus.protocols.sms.options import SmsBus

FOLDER = Path(__file__).parent / "models"
SUFFIX = ".yaml"


@cache
def packaged_models() -> Mapping[str, SmsModel]:
    """By name."""
    models = (read_model(path) for path in sorted(FOLDER.glob(f"*{SUFFIX}")))
    return {model.name: model for model in models}


def load_models(options: SmsBus, folder: Path) -> Mapping[str, SmsModel]:
    """The models that a bus's servos name; own files are looked for from `folder` on. Raises ConfigError."""
    return {name: find_model(name, folder) for name in dict.fromkeys(servo.model for servo in options.servos.values())}


def find_model(name: str, folder: Path) -> SmsModel:
    """A packaged model, or the file of that name. Raises ConfigError."""
    packaged = packaged_models()
    if name in packaged:
        return packaged[name]
    if not name.endswith(SUFFIX):
        raise ConfigError(
            f"model {yamlfile.clip(name)!r} is not known; there are {', '.join(packaged)}, or name a file *{SUFFIX}"
        )
    return read_model(folder / name)


def read_model(path: Path) -> SmsModel:
    """The model in a file. Raises ConfigError with the places of what is wrong."""
    document = yamlfile.read(path)
    complaints = Complaints(document)
    data = document.data
    if isinstance(data, dict) and "extends" in data:
        data = _extended(data, complaints)
    model = complaints.validated(SmsModel, data, ())
    complaints.raise_any()
    assert isinstance(model, SmsModel)
    return model


def _extended(data: Mapping[str, Any], complaints: Complaints) -> Any:
    """The packaged model of that name, with what this file says instead."""
    known = [path.stem for path in sorted(FOLDER.glob(f"*{SUFFIX}"))]
    if data["extends"] not in known:
        complaints.add(("extends",), f"found {show(data['extends'])}; there are {', '.join(known)}")
        complaints.raise_any()
    return merged(_packaged_data(data["extends"]), {key: value for key, value in data.items() if key != "extends"})


@cache
def _packaged_data(name: str) -> Mapping[str, Any]:
    """What stands in a packaged file, which takes long to read."""
    data: Mapping[str, Any] = yamlfile.read(FOLDER / f"{name}{SUFFIX}").data
    return data


def merged(base: Any, change: Any) -> Any:
    """Mappings key by key, everything else as the change says."""
    if not (isinstance(base, Mapping) and isinstance(change, Mapping)):
        return change
    return {**base, **{key: merged(base.get(key), value) for key, value in change.items()}}
