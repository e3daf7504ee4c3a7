"""One tree of everything that can go wrong, for every package and every door.

An error is immutable: its attributes cannot be set once it is made. `error.at(bus=, servo=)` makes a new one that also says where
it happened. The message ends with the next step. The exit status of the command line follows from the class (`exit_status`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NoReturn, Self, TypeVar

E = TypeVar("E", bound="ServobusError")


class ServobusError(Exception):
    """The root of the tree: catch it to catch whatever servobus raises on purpose.

    Args:
        message: What happened, what was expected, and what to do next.
        bus: Name of the bus, where it is known.
        servo: Name of the servo, where it is known.
        request: The request that failed, where there was one.
        raw: The bytes on the wire that the error is about.

    Attributes: message, bus, servo, request, raw (as the arguments); exit_status (class attribute, for the command line).
    """

    exit_status = 1

    message: str
    bus: str | None
    servo: str | None
    request: object
    raw: bytes

    def __init__(
        self, message: str, *, bus: str | None = None, servo: str | None = None, request: object = None, raw: bytes = b""
    ) -> None:
        super().__init__(message)
        self.__dict__.update(message=message, bus=bus, servo=servo, request=request, raw=raw)

    def __str__(self) -> str:
        where = "/".join(part for part in (self.bus, self.servo) if part)
        return f"{where}: {self.message}" if where else self.message

    def __setattr__(self, name: str, value: object) -> None:
        if not name.startswith("__"):  # Python itself sets __traceback__, __context__, __notes__
            self._refuse(name)
        super().__setattr__(name, value)

    def __delattr__(self, name: str) -> None:
        self._refuse(name)

    def _refuse(self, name: str) -> NoReturn:
        raise AttributeError(f"{type(self).__name__}.{name}: an error is immutable, `at` makes a new one")

    def __reduce__(self) -> tuple[Any, ...]:
        return _copy, (type(self), self.args, self.__dict__)

    def at(self, *, bus: str | None = None, servo: str | None = None) -> Self:
        """Make a new error that also says where it happened.

        Args:
            bus: Name of the bus; one that is known already is kept.
            servo: Name of the servo; one that is known already is kept.

        Returns:
            An error of the same class, with the same message, cause and traceback.
        """
        error = _copy(type(self), self.args, {**self.__dict__, "bus": self.bus or bus, "servo": self.servo or servo})
        error.__cause__, error.__context__ = self.__cause__, self.__context__
        error.__suppress_context__ = self.__suppress_context__
        return error.with_traceback(self.__traceback__)


def _copy(kind: type[E], args: tuple[Any, ...], attributes: dict[str, Any]) -> E:
    """An error with exactly these attributes, whatever arguments its class takes."""
    error = kind.__new__(kind, *args)
    error.__dict__.update(attributes)
    if "__notes__" in attributes:
        error.__dict__["__notes__"] = list(attributes["__notes__"])
    return error


class ConfigError(ServobusError):
    """A file or an option cannot be used. Where a file is at fault, the message begins with `file:line:column`."""

    exit_status = 2


class UnknownName(ServobusError):
    """No bus, servo, register, command or model has this name, or several servos share the bare name."""

    exit_status = 2


class NotSupported(ServobusError):
    """This model, protocol or line cannot do what was asked."""

    exit_status = 2


class InvalidRequest(ServobusError):
    """The call contradicts itself or is too long: a servo is named twice, say. Nothing was sent."""

    exit_status = 2


class LimitError(ServobusError):
    """A value is outside a limit, not finite, or not a number. Nothing was sent."""

    exit_status = 2


class LinkDown(ServobusError):
    """The line, or the connection to the daemon, is not open. A request that was under way may have been applied."""


class PortMissing(LinkDown):
    """The device file does not exist or is not a serial port."""


class PortBusy(LinkDown):
    """Another process holds the port. The message names the process where the system tells it."""


class PortDenied(LinkDown):
    """The system does not let this user open the port."""


class ReplyTimeout(ServobusError):
    """No acceptable reply came within the deadline, or the servo is offline. A write may have been applied."""


class SettleTimeout(ReplyTimeout):
    """The servo did not reach its goal in time. The message says where it is and where it was to go."""


class DeviceError(ServobusError):
    """The device answered that it did not do what was asked.

    Args:
        message: As in ServobusError.
        code: The number that the device gave: a status byte, an abort code or an exception code; None: it gave none.
        where: bus, servo, request and raw, as in ServobusError.

    Attributes: those of ServobusError, and code.
    """

    code: int | None

    def __init__(self, message: str, *, code: int | None = None, **where: Any) -> None:
        super().__init__(message, **where)
        self.__dict__["code"] = code


class EchoMismatch(ServobusError):
    """The device confirmed another value than the one sent."""


class NotEnabled(ServobusError):
    """The servo is not enabled, or lost its torque because it restarted. Nothing was sent."""


class EStopped(ServobusError):
    """The e-stop is latched: `clear` releases it. Nothing was sent."""


class LeaseHeld(ServobusError):
    """Another client holds the motion lease of the servo. Nothing was sent."""


class Busy(ServobusError):
    """The bus or the rig is in use by a scan, commissioning, a reload, a stop or enabled servos. Nothing was sent."""


class AccessDenied(ServobusError):
    """The client's role does not allow this, or its token is wrong. Nothing was done."""


class Overloaded(ServobusError):
    """A bounded queue is full. Nothing was sent; ask for less, or later."""


class GoalExpired(ServobusError):
    """The first byte of the goal could not leave within its `start_within`. Nothing was sent."""


class ActionWithheld(ServobusError):
    """A confirmed group did not start, because not all of its servos were ready. What was armed has been disarmed."""


class PartialFailure(ServobusError):
    """Some servos did what was asked and some did not.

    Args:
        results: The outcome or the error of each servo, by name.
        where: bus, servo, request and raw, as in ServobusError.

    Attributes: those of ServobusError, and results.
    """

    results: dict[str, Any]

    def __init__(self, results: Mapping[str, Any], **where: Any) -> None:
        causes: dict[str, list[str]] = {}
        for name, result in results.items():
            if isinstance(result, Exception):
                causes.setdefault(str(getattr(result, "message", result)), []).append(name)
        failed = sum(map(len, causes.values()))
        listing = "; ".join(f"{', '.join(names)}: {cause}" for cause, names in causes.items())
        super().__init__(f"{failed} of {len(results)} failed: {listing}", **where)
        self.__dict__["results"] = dict(results)
