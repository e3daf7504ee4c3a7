"""What the service remembers of one servo between two turns."""

from __future__ import annotations

from typing import Any

from servobus.engine.health import Node
from servobus.protocols.options import ServoOptions
from servobus.values import Health, Identity, State, Update


class ServoRecord:
    """Host-side state of a servo. Fields of State come from replies; `enabled` is our own doing."""

    __slots__ = (
        "_fields",
        "enabled",
        "generation",
        "identify_after",
        "identity",
        "name",
        "node",
        "options",
        "position_at",
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
        """We may have switched its torque on, even if enable() did not come through: at the end it is left as `on_exit` says."""
        self.identity: Identity | None = None
        self.identify_after = 0.0
        """Not before this is an unknown servo asked again who it is."""
        self.setpoint: float | None = None
        """The last position asked for, or held."""
        self.position_at: float | None = None
        self.updated_at: float | None = None
        self._fields: dict[str, Any] = {}

    def update(self, fields: Update, now: float) -> None:
        self._fields.update(fields)
        self.updated_at = now
        if "position" in fields:
            self.position_at = now

    def position(self, now: float, max_age: float) -> float | None:
        """The last position heard, if it is fresh enough."""
        if self.position_at is None or now - self.position_at > max_age:
            return None
        position: float | None = self._fields.get("position")
        return position

    def reference(self) -> float | None:
        """Where a step is counted from: the last setpoint, else the last position heard."""
        return self.setpoint if self.setpoint is not None else self._fields.get("position")

    def state(self, now: float, faults: tuple[str, ...]) -> State:
        fields = dict(self._fields)
        status = fields.pop("status", None) if self.node.status is None else self.node.status
        fields.pop("status", None)
        goal = fields.pop("goal", None) if self.setpoint is None else self.setpoint
        fields.pop("goal", None)
        return State(
            **fields,
            goal=goal,
            enabled=self.enabled,
            faults=faults,
            status=status,
            health=Health(self.node.condition.value),
            time=self.updated_at,
            age=None if self.updated_at is None else now - self.updated_at,
        )
