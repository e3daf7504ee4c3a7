"""servobus: one asyncio service that owns a robot's serial lines and gives many callers safe, awaitable access to many servos.

Every public name is loaded when it is first used: `import servobus` costs nothing, and a client of a daemon needs no engine.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

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
    from servobus.rig.events import Event
    from servobus.rig.interface import Found, Reload, Rig, Servo, Snapshot
    from servobus.rig.local import LocalRig
    from servobus.rig.opening import open_rig as open
    from servobus.values import Change, Goal, Identity, Outcome, State, StopReport

    __version__: str

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
    "__version__",
    "blocking",
    "connect",
    "open",
]

_MODULES = {
    "Event": "rig.events",
    "LocalRig": "rig.local",
    "RemoteRig": "remote.rig",
    "connect": "remote.rig",
    "open": "rig.opening",
    **dict.fromkeys(("Found", "Reload", "Rig", "Servo", "Snapshot"), "rig.interface"),
    **dict.fromkeys(("Change", "Goal", "Identity", "Outcome", "State", "StopReport"), "values"),
}
"""Public name -> its module; a name that is missing here is an error's."""
_OTHER_NAMES = {"open": "open_rig"}
"""Public name -> its name in that module, where the two differ."""


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value: Any
    if name == "__version__":
        value = import_module("importlib.metadata").version("servobus")
    elif name == "blocking":
        value = import_module("servobus.blocking")
    else:
        value = getattr(import_module(f"servobus.{_MODULES.get(name, 'errors')}"), _OTHER_NAMES.get(name, name))
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
