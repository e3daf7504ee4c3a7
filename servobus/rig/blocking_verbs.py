"""The verbs of `Rig` and `Servo` as plain calls, for `servobus.blocking`: made from the verbs themselves.

What type checkers see of these classes is in `blocking_verbs.pyi`, which `scripts/stubs` writes from `interface.py`.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any

from servobus.rig.interface import Rig, Servo


def _waiting(verb: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(verb)
    def call(self: Any, /, *args: Any, **kwargs: Any) -> Any:
        return self.wait(getattr(self.inner, verb.__name__), *args, **kwargs)

    return call


def _verbs(interface: type) -> dict[str, Any]:
    """Every verb of the interface, by name, with its own signature and docstring."""
    coroutines = {name: value for name, value in vars(interface).items() if inspect.iscoroutinefunction(value)}
    return {name: _waiting(verb) for name, verb in coroutines.items() if not name.startswith("_")}


RigVerbs = type("RigVerbs", (), _verbs(Rig))
ServoVerbs = type("ServoVerbs", (), _verbs(Servo))
