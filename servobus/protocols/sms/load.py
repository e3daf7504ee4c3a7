from __future__ import annotations
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any
from servobus import yamlfile
from servobus.protocols.sms.model import SmsModel
from servobus.protocols.sms.options import SmsBus
FOLDER = Path(__file__).parent / "models"

@cache
def packaged_models() -> Mapping[str, SmsModel]:
    found = {}
    for path in sorted(FOLDER.glob("*.yaml")):
        model = SmsModel.model_validate(yamlfile.read(path).data)
        found[model.name] = model
    return found

def load_models(options: SmsBus, folder: Path) -> Mapping[str, SmsModel]:
    return {servo.model: packaged_models()[servo.model] for servo in options.servos.values()}
