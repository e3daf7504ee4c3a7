"""One tree of everything that can go wrong, for every floor and every door.

Each error carries where it happened (`bus`, `servo`), what was asked (`request`) and what was on the wire (`raw`). Its message
ends with the next step. Exit statuses of the command line hang on the class: see `exit_status`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


class ServobusError(Exception):
    """The root: catch this to catch whatever servobus raises on purpose."""

    exit_status = 1

    def __init__(
        self,
        message: str,
        *,
        bus: str | None = None,
        servo: str | None = None,
        request: object = None,
        raw: bytes = b"",
    ) -> None:
        super().__init__(message)
        self.message = message
        self.bus = bus
        self.servo = servo
        self.request = request
        self.raw = raw

    def __str__(self) -> str:
        where = "/".join(part for part in (self.bus, self.servo) if part)
        return f"{where}: {self.message}" if where else self.message

    def at(self, *, bus: str | None = None, servo: str | None = None) -> ServobusError:
        """Add the place where a higher floor knows it; what is already known stays."""
        self.bus = self.bus or bus
        self.servo = self.servo or servo
        return self


class ConfigError(ServobusError):
    """A file or an option that cannot be used. The message begins with `file:line:column`."""

    exit_status = 2


class UnknownName(ServobusError):
    """A bus, servo, register or model of that name does not exist, or the bare name stands for several."""

    exit_status = 2


class NotSupported(ServobusError):
    """This model, protocol or line cannot do what was asked."""

    exit_status = 2


class LinkDown(ServobusError):
    """The line is not there now: nothing was sent, or what was in flight may or may not have been applied."""


class PortMissing(LinkDown):
    """The device file does not exist or is no serial port."""


class PortBusy(LinkDown):
    """Another process holds the port; the message names it where the system tells."""


class PortDenied(LinkDown):
    """The system does not let this user open the port."""


class ReplyTimeout(ServobusError):
    """No acceptable reply came within the deadline, or the servo is offline. A write may have been applied."""


class DeviceError(ServobusError):
    """The device answered that it did not do what was asked."""

    def __init__(self, message: str, *, code: int | None = None, **where: Any) -> None:
        super().__init__(message, **where)
        self.code = code


class EchoMismatch(ServobusError):
    """The device confirmed another value than the one sent."""


class LimitError(ServobusError):
    """The value is outside a limit, not finite, or no number. Nothing was sent."""

    exit_status = 2


class NotEnabled(ServobusError):
    """The servo is not enabled (or was disabled because it rebooted). Nothing was sent."""


class EStopped(ServobusError):
    """The e-stop is latched: `clear` releases it. Nothing was sent."""


class LeaseHeld(ServobusError):
    """Another client, or an exclusive session, holds motion here. Nothing was sent."""


class AccessDenied(ServobusError):
    """Your role does not allow that, or the token is not right. Nothing was done."""


class Overloaded(ServobusError):
    """A bounded queue is full. Nothing was sent; ask for less, or later."""


class GoalExpired(ServobusError):
    """The goal's time to live passed before its first byte could leave. Nothing was sent."""


class ActionWithheld(ServobusError):
    """A confirmed group did not start, because not all of its servos were ready. What was armed has been disarmed."""


class PartialFailure(ServobusError):
    """Some servos did it and some did not: `results` maps each name to its outcome or its error."""

    def __init__(self, results: Mapping[str, Any], **where: Any) -> None:
        self.results = dict(results)
        failed = {name: result for name, result in self.results.items() if isinstance(result, Exception)}
        listing = "; ".join(f"{name}: {getattr(error, 'message', error)}" for name, error in failed.items())
        super().__init__(f"{len(failed)} of {len(self.results)} failed: {listing}", **where)
