"""servobus: one asyncio service that owns a robot's serial lines and gives many callers safe, awaitable access to many servos.

`open` makes a rig whose ports this process owns, `connect` one of a running daemon, `blocking` both for scripts without
asyncio. Everything is loaded when it is first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

# fmt: off
if TYPE_CHECKING:
    from servobus import blocking
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
    from servobus.remote.rig import RemoteRig, connect
    from servobus.rig.events import Event, EventStream
    from servobus.rig.interface import Rig, Servo
    from servobus.rig.local import LocalRig
    from servobus.rig.local import open_rig as open
    from servobus.values import Change, EventName, Goal, Health, Identity, Outcome, Reload, ScanHit, Snapshot, State, StopReport

    __version__: str

__all__ = [
    "AccessDenied", "ActionWithheld", "Busy", "Change", "ConfigError", "DeviceError", "EStopped", "EchoMismatch", "Event",
    "EventName", "EventStream", "Goal", "GoalExpired", "Health", "Identity", "InvalidRequest", "LeaseHeld", "LimitError",
    "LinkDown", "LocalRig", "NotEnabled", "NotSupported", "Outcome", "Overloaded", "PartialFailure", "PortBusy",
    "PortDenied", "PortMissing", "Reload", "RemoteRig", "ReplyTimeout", "Rig", "ScanHit", "Servo", "ServobusError",
    "SettleTimeout", "Snapshot", "State", "StopReport", "UnknownName", "__version__", "blocking", "connect", "open",
]
# fmt: on
_MODULES = {
    "rig.local": {"LocalRig", "open"},
    "remote.rig": {"RemoteRig", "connect"},
    "rig.interface": {"Rig", "Servo"},
    "rig.events": {"Event", "EventStream"},
    "values": {
        *("Change", "EventName", "Goal", "Health", "Identity", "Outcome", "Reload", "ScanHit", "Snapshot", "State", "StopReport")
    },
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name == "__version__":
        value: Any = import_module("importlib.metadata").version(__name__)
    elif name == "blocking":
        value = import_module("servobus.blocking")
    else:
        module = next((module for module, names in _MODULES.items() if name in names), "errors")
        value = getattr(import_module(f"{__name__}.{module}"), "open_rig" if name == "open" else name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
