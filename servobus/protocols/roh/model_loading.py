"""The register maps of ROH hands, as packaged files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from servobus.errors import ConfigError
from servobus.protocols.model_files import ModelFiles
from servobus.protocols.roh.model import CHANNELS, RohModel
from servobus.protocols.roh.options import MAPS, RohBus, RohServo

FILES = ModelFiles(RohModel, Path(__file__).parent / "models")
NEWEST = MAPS[-1]
"""Stands for a map that is not known yet where nothing is sent: config checks, timing load, simulated hands."""


def packaged_models() -> Mapping[str, RohModel]:
    """By name."""
    return FILES.packaged


def load_models(options: RohBus, folder: Path) -> Mapping[str, RohModel]:
    """All maps, for which one a hand has is known only when it is asked; and what config checks measure a finger by. Raises
    ConfigError for limits in degrees that the finger cannot reach."""
    found = packaged_models()
    for name, servo in options.servos.items():
        _check_angles(name, servo, found[NEWEST])
    return {**found, "finger": found[NEWEST]}


def _check_angles(name: str, servo: RohServo, model: RohModel) -> None:
    if servo.unit != "deg":
        return
    calibration = servo.calibration(model)
    least, greatest = sorted(calibration.to_unit(angle / model.units["deg"]) for angle in model.angles[servo.channel])
    for value in (*(servo.limits or ()), servo.park_pose):
        if value is not None and not least - 1e-9 <= value <= greatest + 1e-9:
            raise ConfigError(f"servo {name}: {value:g} deg is outside {least:g} to {greatest:g}, what {servo.channel} reaches")


def channel_number(servo: RohServo) -> int:
    """Its place in each row of registers."""
    return CHANNELS.index(servo.channel)
