"""How a command ends that fails or is interrupted: what it says, and which servos it leaves energised.

`status_of` makes one Ending for each command; `of_command` finds it again. What is left is said on standard error, and with
`--json` in the one document on standard output: `{"error": {...}, "left": {...}}`.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import click

from servobus.cli.output import echo, emit
from servobus.errors import ServobusError
from servobus.values import StopReport

INTERRUPTED = 128 + signal.SIGINT
TERMINATED = 128 + signal.SIGTERM
DONE = {"hold": "holds", "limp": "limp", "none": "as it was", "park": "parked, limp", "stays": "stays energised"}
"""What an action that is confirmed has made of a servo."""


def _say(text: str) -> None:
    echo(f"servobus: {text}", err=True)


@dataclass
class Ending:
    """What is known of the servos that a command has energised.

    Attributes:
        as_json: The command prints JSON.
        say: Tells a person.
        energised: Returns the servos that may be energised now because of the command, by full name, and what its end does to
            each; None: it has reached no rig yet.
        has_daemon: They are a daemon's, which keeps them.
        left: What the end has done to each of them.
        emitted: The command has printed its document.
    """

    as_json: bool = False
    say: Callable[[str], object] = _say
    energised: Callable[[], Mapping[str, str]] | None = None
    has_daemon: bool = False
    left: dict[str, StopReport] = field(default_factory=dict)
    emitted: bool = False

    def interrupted(self) -> None:
        """A first signal has come: say what is done now."""
        servos = self.energised() if self.energised is not None else {}
        listing = ", ".join(f"{name} ({action})" for name, action in servos.items())
        if servos and self.has_daemon:
            self.say(f"interrupted: the daemon does on_lost_client of what this command moves; energised: {', '.join(servos)}")
        elif servos:
            self.say(f"interrupted: doing on_exit of {listing}; interrupt again to end at once")

    def abandoned(self) -> None:
        """A second signal has come, and the process ends at once: say what is left."""
        servos = self.energised() if self.energised is not None else {}
        self.say(f"left energised: {', '.join(servos) or 'nothing'}")
        detail = "the command was interrupted twice: check the servo before you touch it"
        self.left.update({name: StopReport(action, False, False, detail) for name, action in servos.items()})
        self._emit({"type": "Interrupted", "message": "interrupted twice"})

    def failed(self, error: BaseException, message: str = "interrupted") -> None:
        """The command ends with this error, which was said: say what is left."""
        for name, report in self.left.items():
            self.say(f"{name}: {described(report)}")
        self._emit(_as_data(error, message))

    def _emit(self, error: Mapping[str, Any]) -> None:
        if self.as_json and not self.emitted:
            emit({"error": error, "left": {name: asdict(report) for name, report in self.left.items()}})


def described(report: StopReport) -> str:
    """What an end has done to a servo, for a person."""
    if report.confirmed:
        return f"left: {DONE.get(report.action, report.action)}{report.detail and f' ({report.detail})'}"
    return f"{report.action} not confirmed, it may be energised ({report.detail}): check the servo before you touch it"


def of_command() -> Ending:
    """The Ending of the command under way."""
    context = click.get_current_context(silent=True)
    ending = None if context is None else context.find_object(Ending)
    return Ending() if ending is None else ending


def _as_data(error: BaseException, message: str) -> dict[str, Any]:
    """The error as a program reads it."""
    if isinstance(error, ServobusError):
        from servobus.rpc.errors import encoded

        data: dict[str, Any] = encoded(error)["data"]
        return data
    interrupted = isinstance(error, (KeyboardInterrupt, SystemExit, click.Abort))
    return {"type": "Interrupted" if interrupted else type(error).__name__, "message": message}
