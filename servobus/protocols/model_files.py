"""Model files: those packaged with a protocol, and users' own beside a config, which may extend a packaged one."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, Generic, TypeVar

from servobus.documents import reader
from servobus.documents.problems import Problems, quote
from servobus.errors import ConfigError
from servobus.protocols.model import ServoModel

M = TypeVar("M", bound=ServoModel)
SUFFIX = ".yaml"


class ModelFiles(Generic[M]):
    """The models of one protocol: of `kind`, packaged in `folder`."""

    def __init__(self, kind: type[M], folder: Path) -> None:
        self._kind = kind
        self.folder = folder
        self._data: dict[str, Mapping[str, Any]] = {}

    @cached_property
    def packaged(self) -> Mapping[str, M]:
        """By name."""
        models = (self.read(path) for path in sorted(self.folder.glob(f"*{SUFFIX}")))
        return {model.name: model for model in models}

    def find(self, name: str, folder: Path) -> M:
        """A packaged model, or the own file of that name, looked for from `folder` on. Raises ConfigError."""
        if name in self.packaged:
            return self.packaged[name]
        if not name.endswith(SUFFIX):
            known = ", ".join(self.packaged)
            raise ConfigError(f"model {reader.clip(name)!r} is not known; there are {known}, or name a file *{SUFFIX}")
        return self.read(folder / name)

    def read(self, path: Path) -> M:
        """The model in a file. Raises ConfigError with the places of what is wrong."""
        document = reader.read(path)
        problems = Problems(document)
        data = document.data
        if isinstance(data, dict) and "extends" in data:
            data = self._extended(data, problems)
        model = problems.validated(self._kind, data, ())
        problems.raise_any()
        assert isinstance(model, self._kind)
        return model

    def _extended(self, data: Mapping[str, Any], problems: Problems) -> Any:
        """The packaged model of that name, with what this file says instead."""
        base = data["extends"]
        known = [path.stem for path in sorted(self.folder.glob(f"*{SUFFIX}"))]
        if base not in known:
            problems.add(("extends",), f"found {quote(base)}; there are {', '.join(known)}")
            problems.raise_any()
        if base not in self._data:  # it takes long to read
            self._data[base] = reader.read(self.folder / f"{base}{SUFFIX}").data
        return merged(self._data[base], {key: value for key, value in data.items() if key != "extends"})


def merged(base: Any, change: Any) -> Any:
    """Mappings key by key, everything else as the change says."""
    if not (isinstance(base, Mapping) and isinstance(change, Mapping)):
        return change
    return {**base, **{key: merged(base.get(key), value) for key, value in change.items()}}
