"""FEETECH model files: the packaged ones, and those that stand beside a config and may extend them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from servobus.protocols.model_files import ModelFiles
from servobus.protocols.sms.model import SmsModel
from servobus.protocols.sms.options import SmsBus

FILES = ModelFiles(SmsModel, Path(__file__).parent / "models")


def packaged_models() -> Mapping[str, SmsModel]:
    """By name."""
    return FILES.packaged


def load_models(options: SmsBus, folder: Path) -> Mapping[str, SmsModel]:
    """The models that a bus's servos name; own files are looked for from `folder` on. Raises ConfigError."""
    return {name: FILES.find(name, folder) for name in dict.fromkeys(servo.model for servo in options.servos.values())}
