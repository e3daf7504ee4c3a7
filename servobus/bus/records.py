"""What servobus keeps of one servo between two turns. Pure."""

from __future__ import annotations

from typing import Any

from servobus.engine.health import Node
from servobus.protocols.options import ServoOptions
from servobus.values import Identity, State, Update


class ServoRecord:
    """Host-side state of a servo. Fields of `State` come from replies; `enabled`, `goal` and `setpoint` are our own doing."""

    __slots__ = (
        "_fields",
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
        self.position_at: float | None = None
        self.updated_at: float | None = None
        self._fields: dict[str, Any] = {}

    def update(self, fields: Update, now: float) -> None:
        self._fields.update(fields)
        self.updated_at = now
        if "position" in fields:
            self.position_at = now

    def hold_at(self, position: float | None) -> None:
        """Note that the servo holds this position; None: it is not known where."""
        self.goal = self.setpoint = position
        self.ramped = False

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
        goal = fields.pop("goal", None)
        return State(
            **fields,
            goal=goal if self.goal is None else self.goal,
            enabled=self.enabled,
            faults=faults,
            status=status if self.node.status is None else self.node.status,
            health=self.node.health,
            time=self.updated_at,
            age=None if self.updated_at is None else now - self.updated_at,
        )
