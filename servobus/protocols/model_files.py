"""Reads model files: those packaged with a protocol, and the user's own beside a config, which may extend a packaged one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
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
        """The packaged models by name."""
        models = (self.read(path) for path in sorted(self.folder.glob(f"*{SUFFIX}")))
        return {model.name: model for model in models}

    def find(self, name: str, folder: Path) -> M:
        """Return a packaged model, or the model in the user's file of that name (relative to `folder`). Raises ConfigError."""
        if name in self.packaged:
            return self.packaged[name]
        if not name.endswith(SUFFIX):
            names = ", ".join(self.packaged)
            raise ConfigError(f"model {reader.clip(name)!r} is not known; there are {names}, or name a file *{SUFFIX}")
        return self.read(folder / name)

    def load(self, names: Iterable[str], folder: Path) -> dict[str, M]:
        """Return the models of these names; see `find`."""
        return {name: self.find(name, folder) for name in dict.fromkeys(names)}

    def read(self, path: Path) -> M:
        """Return the model in a file. Raises ConfigError, which names the line of each problem."""
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
        """Return the packaged model that the file extends, changed by the file's own keys."""
        base = data["extends"]
        names = [path.stem for path in sorted(self.folder.glob(f"*{SUFFIX}"))]
        if base not in names:
            problems.add(("extends",), f"found {quote(base)}; there are {', '.join(names)}")
            problems.raise_any()
        if base not in self._data:  # reading it takes long
            self._data[base] = reader.read(self.folder / f"{base}{SUFFIX}").data
        return merged(self._data[base], {key: value for key, value in data.items() if key != "extends"})


def merged(base: Any, change: Any) -> Any:
    """Return `base` with the changes: mappings are merged key by key, everything else is replaced."""
    if not (isinstance(base, Mapping) and isinstance(change, Mapping)):
        return change
    return {**base, **{key: merged(base.get(key), value) for key, value in change.items()}}
