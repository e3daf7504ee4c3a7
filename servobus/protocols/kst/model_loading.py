"""Where KST models come from: the packaged file, or a file of the user's own beside the config, which may extend it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from servobus.errors import ConfigError
from servobus.protocols.kst.model import KstModel
from servobus.protocols.kst.options import KstBus, KstServo
from servobus.protocols.model_files import ModelFiles

NAME = "kst"
FILES = ModelFiles(KstModel, Path(__file__).parent / "models")


def packaged_model() -> KstModel:
    return FILES.packaged[NAME]


def load_models(options: KstBus, folder: Path) -> Mapping[str, KstModel]:
    """The models that a bus's servos name; own files are looked for from `folder` on. Raises ConfigError."""
    found: dict[str, KstModel] = {}
    for name, servo in options.servos.items():
        if servo.model not in found:
            found[servo.model] = FILES.find(servo.model, folder)
        _check_range(name, servo, found[servo.model])
    return found


def _check_range(name: str, servo: KstServo, model: KstModel) -> None:
    """What lies beyond the model's range needs a model file that says it can be reached."""
    if servo.range_deg is None:
        return
    least, greatest = (end * model.units["deg"] for end in model.range)
    if servo.range_deg[0] < least or servo.range_deg[1] > greatest:
        raise ConfigError(
            f"servo {name}: range_deg {list(servo.range_deg)} is wider than the model's {least:g} to {greatest:g}: narrow it, or "
            "name a model file whose range is known to be wider"
        )
