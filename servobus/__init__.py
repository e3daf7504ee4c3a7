"""servobus: one asyncio service that owns a robot's serial lines and gives many callers safe, awaitable access to many servos.

`open`, `connect` and `blocking` are loaded when they are first used: a client of a daemon needs no engine.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from servobus.errors import (
    AccessDenied,
    ActionWithheld,
    Busy,
    ConfigError,
    DeviceError,
    EchoMismatch,
    EStopped,
    GoalExpired,
    InvalidRequest,
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
    SettleTimeout,
    UnknownName,
)
from servobus.rig.events import Event
from servobus.rig.interface import Found, Reload, Rig, Servo, Snapshot
from servobus.values import Change, Goal, Identity, Outcome, State, StopReport

if TYPE_CHECKING:
    from servobus import blocking
    from servobus.remote.rig import RemoteRig, connect
    from servobus.rig.local import LocalRig
    from servobus.rig.opening import open_rig as open

__all__ = [
    "AccessDenied",
    "ActionWithheld",
    "Busy",
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
    "InvalidRequest",
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
    "SettleTimeout",
    "Snapshot",
    "State",
    "StopReport",
    "UnknownName",
    "blocking",
    "connect",
    "open",
]

_LATER = {
    "LocalRig": ("servobus.rig.local", "LocalRig"),
    "RemoteRig": ("servobus.remote.rig", "RemoteRig"),
    "blocking": ("servobus.blocking", None),
    "connect": ("servobus.remote.rig", "connect"),
    "open": ("servobus.rig.opening", "open_rig"),
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
