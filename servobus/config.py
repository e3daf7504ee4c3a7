from __future__ import annotations
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from servobus import yamlfile
from servobus.protocols.model import ServoModel
from servobus.protocols.options import BusOptions
from servobus.protocols.table import PROTOCOLS

@dataclass(frozen=True)
class Config:
    version: int
    buses: Mapping[str, BusOptions]
    models: Mapping[str, Mapping[str, ServoModel]]
    path: Path | None = None

def parse_config(text: str, name: str, folder: Path = Path()) -> Config:
    data = yamlfile.parse(text, name).data
    buses = {n: PROTOCOLS[b["protocol"]].options.model_validate(b) for n, b in data["buses"].items()}
    return Config(1, buses, {n: PROTOCOLS[o.protocol].models(o, folder) for n, o in buses.items()})

def load_config(path: str | Path) -> Config:
    return parse_config(Path(path).read_text(), str(path), Path(path).parent)
