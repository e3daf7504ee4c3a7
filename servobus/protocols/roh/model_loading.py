"""The packaged register maps of ROH hands, and the config checks that need them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from servobus.errors import ConfigError
from servobus.protocols.model_files import ModelFiles
from servobus.protocols.roh.model import RohModel
from servobus.protocols.roh.options import MAPS, RohBus, RohServo

FILES = ModelFiles(RohModel, Path(__file__).parent / "models")
NEWEST = MAPS[-1]
"""The map that is assumed where a hand's map is not known and nothing is sent: config checks, previews, simulated hands."""


def packaged_models() -> Mapping[str, RohModel]:
    """Return the maps by name."""
    return FILES.packaged


def load_models(options: RohBus, folder: Path) -> Mapping[str, RohModel]:
    """Return all maps, because a hand's map is only known when it was asked, and `finger`, which config checks use.

    Raises ConfigError for limits in degrees that the finger cannot reach.
    """
    maps = packaged_models()
    for name, servo in options.servos.items():
        _check_angles(name, servo, maps[NEWEST])
    return {**maps, "finger": maps[NEWEST]}


def _check_angles(name: str, servo: RohServo, model: RohModel) -> None:
    if servo.unit != "deg":
        return
    calibration = servo.calibration(model)
    low, high = sorted(calibration.to_unit(angle / model.units["deg"]) for angle in model.angles[servo.channel])
    for value in (*(servo.limits or ()), servo.park_pose):
        if value is not None and not low - 1e-9 <= value <= high + 1e-9:
            raise ConfigError(f"servo {name}: {value:g} deg is outside {low:g} to {high:g}, the range of {servo.channel}")
