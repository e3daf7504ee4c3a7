"""What servobus keeps of one servo between two turns. Pure."""

from __future__ import annotations

from typing import Any

from servobus.engine.health import Node
from servobus.errors import ServobusError
from servobus.protocols.options import ServoOptions
from servobus.values import Identity, State, Update


class ServoRecord:
    """Host-side state of a servo. Fields of `State` come from replies; `enabled`, `goal` and `setpoint` are our own doing."""

    __slots__ = (
        "_fields",
        "cut",
        "enabled",
        "generation",
        "goal",
        "identify_after",
        "identity",
        "name",
        "node",
        "options",
        "position_at",
        "ramped",
        "setpoint",
        "touched",
        "updated_at",
    )

    def __init__(self, name: str, options: ServoOptions, node: Node) -> None:
        self.name = name
        self.options = options
        self.node = node
        self.enabled = False
        self.generation = 0
        """Counts what ends an enable that is under way: disable, limp."""
        self.touched = False
        """We may have switched its torque on, even if `enable` failed half-way: at exit it is left as `on_exit` says."""
        self.identity: Identity | None = None
        self.identify_after = 0.0
        """Before this time a servo that could not be identified is not asked again."""
        self.goal: float | None = None
        """The last position asked for, or held."""
        self.setpoint: float | None = None
        """The last position sent, or held: behind `goal` while the host ramps the servo."""
        self.ramped = False
        """The setpoint is one of a ramp."""
        self.cut: ServobusError | None = None
        """Why its last motion was ended before it arrived; None: it was not."""
        self.position_at: float | None = None
        self.updated_at: float | None = None
        self._fields: dict[str, Any] = {}

    def update(self, fields: Update, now: float) -> None:
        """Keep what a reply brought."""
        self._fields.update(fields)
        self._fields.pop("loss", None)
        self.updated_at = now
        if "position" in fields:
            self.position_at = now

    def hold_at(self, position: float | None, cut: ServobusError | None = None) -> None:
        """Note that the servo holds this position; None: it is not known where. `cut`: why its motion was ended, if it was."""
        self.goal = self.setpoint = position
        self.ramped = False
        self.cut = cut

    def disable(self) -> None:
        """Refuse goals from now on, also those of an enable that is under way."""
        self.generation += 1
        self.enabled = False

    @property
    def energised(self) -> bool:
        """Whether its torque was on when it was last read."""
        return bool(self._fields.get("energised"))

    def torque_is(self, *, on: bool) -> None:
        """Note that its torque was read back, on or off."""
        if "energised" in self._fields:
            self._fields["energised"] = on

    def estimate(self, now: float, max_age: float) -> float | None:
        """Return where the servo is taken to be: where it was last read, and on towards its goal at the speed that it had then.

        None: it was not read for `max_age` seconds.
        """
        position, speed = self.position(now, max_age), self._fields.get("speed")
        if position is None or not speed or self.position_at is None:
            return position
        moved = position + speed * (now - self.position_at)
        if self.goal is None:
            return float(moved)
        return float(min(max(moved, min(position, self.goal)), max(position, self.goal)))

    def arrived(self, near: float) -> bool:
        """Return whether it was last read at rest within `near` of its goal; True also where it has none."""
        position = self._fields.get("position")
        return self.goal is None or (
            position is not None and abs(position - self.goal) <= near and not self._fields.get("moving")
        )

    def position(self, now: float, max_age: float) -> float | None:
        """Return the last position read, if it is fresh enough."""
        if self.position_at is None or now - self.position_at > max_age:
            return None
        position: float | None = self._fields.get("position")
        return position

    def reference(self) -> float | None:
        """Return where a step is counted from: the last goal, else the last position read."""
        return self.goal if self.goal is not None else self._fields.get("position")

    def start(self, now: float, max_age: float) -> float | None:
        """Return where a motion starts: the last position read, if it is fresh enough, else the last goal."""
        position = None if self.position_at is None or now - self.position_at > max_age else self._fields.get("position")
        return self.reference() if position is None else position

    def state(self, now: float, faults: tuple[str, ...]) -> State:
        fields = dict(self._fields)
        status = fields.pop("status", None)
        time = self.updated_at if self.position_at is None else self.position_at
        goal = fields.pop("goal", None)
        return State(
            **fields,
            goal=goal if self.goal is None else self.goal,
            enabled=self.enabled,
            faults=faults,
            status=status if self.node.status is None else self.node.status,
            health=self.node.shown_health,
            time=time,
            age=None if time is None else now - time,
        )
