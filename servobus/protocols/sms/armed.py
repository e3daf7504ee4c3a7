"""Which nodes may hold a REG WRITE that nobody has fired, and how they are disarmed (SMS 1.0, 1.3.4 and 1.3.5).

The rule: ACTION to all moves whoever is armed, so it leaves only while every node that is known to answer on the line is a member
of the plan or was read as not armed. A node enters this table

1. when it is heard (identify, inspect) and after every doubtful spell (a fence that succeeded), until its flag was read as 0;
2. when its flag was read as 1: a REG WRITE of another program waits in it;
3. before our own REG WRITE leaves, so that a plan may be closed at any frame; also after the ACTION, which has no reply.

A configured node that never answered is not in the table: it may be absent, or receive all the same. While there is one, each
member gets an ACTION of its own instead, so that a dead servo holds nobody up and nothing of it can be fired.

Only what we armed ourselves is disarmed without being asked: a harmless REG WRITE replaces the goal, an ACTION to this node alone
fires it, and the flag is read back. What another program armed, `enable` and `disable` of that servo disarm.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from enum import Enum, auto

from servobus.errors import ServobusError
from servobus.protocols.base import Plan, ask
from servobus.protocols.sms.requests import Action, Read, RegWrite
from servobus.protocols.sms.servo import UNKNOWN, HostServo

FLAG_ADDRESS = 64
"""The same in every FEETECH memory table: 1 while a REG WRITE waits for ACTION."""
BLIND_REPEATS = 3
"""Times the harmless REG WRITE is sent to a servo that acknowledges no write, before ACTION may follow it."""


class Suspicion(Enum):
    """Why a node is in the table."""

    UNREAD = auto()
    FOREIGN = auto()
    SENT = auto()
    FIRED = auto()


OURS = (Suspicion.SENT, Suspicion.FIRED)


class Armed:
    """The table of one bus."""

    def __init__(self, servos: Mapping[str, HostServo]) -> None:
        self._servos = {servo.node: servo for servo in servos.values()}
        self._nodes: dict[int, Suspicion] = {}
        self._answered: set[int] = set()

    def __contains__(self, node: int) -> bool:
        return node in self._nodes

    @property
    def sent(self) -> bool:
        """Whether a REG WRITE of ours waits in some node, or may wait there."""
        return Suspicion.SENT in self._nodes.values()

    def all_answered(self, members: Collection[int]) -> bool:
        """Whether every configured node that is no member has answered, so that this table tells about it."""
        return self._servos.keys() <= self._answered | set(members)

    # What happens to a node

    def suspect(self, node: int) -> None:
        """It answers, and its flag was not read since it was last in doubt."""
        self._answered.add(node)
        self._nodes.setdefault(node, Suspicion.UNREAD)

    def arming(self, node: int) -> None:
        """A REG WRITE of ours is about to leave."""
        self._nodes[node] = Suspicion.SENT

    def fired(self, node: int) -> None:
        """ACTION to all was sent. It has no reply, so the flag is read before the next one."""
        self._nodes[node] = Suspicion.FIRED

    def read(self, node: int, flag: int) -> bool:
        """Note what the flag was read as; return whether the node is armed."""
        self._answered.add(node)
        if not flag:
            self._nodes.pop(node, None)
        elif self._nodes.get(node) not in OURS:
            self._nodes[node] = Suspicion.FOREIGN
        return bool(flag)

    # Plans

    def flag(self, node: int) -> Plan[bool]:
        """Read the flag of a node; return whether it is armed."""
        return self.read(node, (yield from ask(read_flag(node))))

    def disarm_ours(self, nodes: Collection[int]) -> Plan[None]:
        """Disarm those of these nodes that we armed ourselves, as far as they answer. The plan raises nothing."""
        for node in nodes:
            if self._nodes.get(node) in OURS:
                yield from self._obstacle(node)

    def disarm_sent(self, nodes: Collection[int]) -> Plan[None]:
        """Disarm those of these nodes in which a REG WRITE of ours may wait that was never fired."""
        yield from self.disarm_ours([node for node in nodes if self._nodes.get(node) is Suspicion.SENT])

    def disarm(self, servo: HostServo) -> Plan[bool]:
        """Let the servo fire a write that moves nothing. Return whether its flag was read as 0 then.

        EEPROM is locked; where it has another memory table than its model, torque 0, whose address is the same in every table.
        """
        model, answered = servo.model, servo.answers_writes
        name, raw = (model.torque, 0) if servo.fit.mode == UNKNOWN else (model.lock, 1)
        register = model.registers[name]
        harmless = RegWrite(servo.node, register.address, servo.encode(register, raw), answered=answered)
        try:
            for _ in range(1 if answered else BLIND_REPEATS):
                yield from ask(harmless)
            yield from ask(Action(servo.node, answered=answered))
            return not (yield from self.flag(servo.node))
        except ServobusError:
            return False  # it remains in the table, and withholds the next ACTION to all

    def obstacle(self, members: Collection[int]) -> Plan[str]:
        """Return why ACTION to all must not be sent for these nodes; empty: it may. Asks, and disarms what is ours."""
        for node in sorted(self._nodes.keys() - set(members)):
            reason = yield from self._obstacle(node)
            if reason:
                return reason
        return ""

    def _obstacle(self, node: int) -> Plan[str]:
        ours, servo = self._nodes[node] in OURS, self._servos.get(node)
        name = f"id {node}" if servo is None else servo.name
        try:
            armed = yield from self.flag(node)
        except ServobusError:
            return f"{name} may hold an older REG WRITE that ACTION would carry out, and does not answer: {_way_out(servo)}"
        if not armed or (ours and servo is not None and (yield from self.disarm(servo))):
            return ""
        return f"{name} holds an older REG WRITE that ACTION would carry out: {_way_out(servo)}"


def read_flag(node: int) -> Read[int]:
    """Return the READ of a node's flag."""
    return Read(node, FLAG_ADDRESS, 1, lambda data: data[0])


def _way_out(servo: HostServo | None) -> str:
    if servo is None:
        return "switch its power off and on"
    return f"disable {servo.name} (which disarms it), or switch its power off and on"
