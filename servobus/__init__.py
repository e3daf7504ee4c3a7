"""servobus: one asyncio service that owns a robot's serial lines and gives many callers safe, awaitable access to many servos.

`open`, `connect` and `blocking` are loaded when they are first used: a client of a daemon needs no engine.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from servobus.errors import (
    AccessDenied,
    ActionWithheld,
    ConfigError,
    DeviceError,
    EchoMismatch,
    EStopped,
    GoalExpired,
    LeaseHeld,
    LimitError,
    LinkDown,
    NotEnabled,
    NotSupported,
    Overloaded,
    PartialFailure,
    PortBusy,
    PortDenied,
    PortMissing,
    ReplyTimeout,
    ServobusError,
    UnknownName,
)
from servobus.events import Event
from servobus.protocols.words import Change, Goal, Identity, Outcome, State, StopReport
from servobus.rig import Found, Reload, Rig, Servo, Snapshot

if TYPE_CHECKING:
    from servobus import blocking
    from servobus.client import RemoteRig, connect
    from servobus.local import LocalRig
    from servobus.opening import open_rig as open

__all__ = [
    "AccessDenied",
    "ActionWithheld",
    "Change",
    "ConfigError",
    "DeviceError",
    "EStopped",
    "EchoMismatch",
    "Event",
    "Found",
    "Goal",
    "GoalExpired",
    "Identity",
    "LeaseHeld",
    "LimitError",
    "LinkDown",
    "LocalRig",
    "NotEnabled",
    "NotSupported",
    "Outcome",
    "Overloaded",
    "PartialFailure",
    "PortBusy",
    "PortDenied",
    "PortMissing",
    "Reload",
    "RemoteRig",
    "ReplyTimeout",
    "Rig",
    "Servo",
    "ServobusError",
    "Snapshot",
    "State",
    "StopReport",
    "UnknownName",
    "blocking",
    "connect",
    "open",
]

_LATER = {
    "LocalRig": ("servobus.local", "LocalRig"),
    "RemoteRig": ("servobus.client", "RemoteRig"),
    "blocking": ("servobus.blocking", None),
    "connect": ("servobus.client", "connect"),
    "open": ("servobus.opening", "open_rig"),
}


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = _LATER[name]
    value = import_module(module) if attribute is None else getattr(import_module(module), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_LATER})
