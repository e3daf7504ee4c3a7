"""Configs with one mistake each: its name, the change to a good config, and the line and column of the problem."""

from __future__ import annotations

from dataclasses import dataclass

GOOD = """\
version: 1
buses:
  arm:
    protocol: sms
    port: "sim:"
    baudrate: 1000000
    poll: {feedback: 50}
    servos:
      shoulder: {id: 1, model: sts, limits: [-90, 90]}
      elbow: {id: 2, model: sts}
"""


@dataclass(frozen=True)
class Mistake:
    """`line` and `column` from 1; `message` is a part of the problem."""

    before: str
    after: str
    line: int
    column: int
    message: str

    @property
    def text(self) -> str:
        assert GOOD.count(self.before) == 1, self.before
        return GOOD.replace(self.before, self.after)


MISTAKES = {
    "unknown key": Mistake("    baudrate: 1000000\n", "    baudrate: 1000000\n    baud: 9600\n", 7, 5, "did you mean baudrate?"),
    "duplicate key": Mistake("      elbow:", "      shoulder:", 10, 7, "shoulder again (first on line 9)"),
    "duplicate id": Mistake("id: 2", "id: 1", 10, 19, "buses.arm.servos.elbow.id: found id 1 again"),
    "id out of range": Mistake("id: 2", "id: 254", 10, 19, "found 254; expected less than or equal to 253"),
    "boolean for a number": Mistake(
        "id: 2", "id: yes", 10, 19, "buses.arm.servos.elbow.id: found 'yes'; expected a valid integer"
    ),
    "limits turned round": Mistake("[-90, 90]", "[90, -90]", 9, 7, "the first must be below the second"),
    "not a number": Mistake("[-90, 90]", "[-90, .nan]", 9, 51, "write a finite number"),
    "unknown model": Mistake("id: 2, model: sts", "id: 2, model: stx", 10, 29, "there are scs, sms, sms_cl, sts"),
    "unknown protocol": Mistake("protocol: sms", "protocol: sns", 4, 15, "buses.arm.protocol: found protocol 'sns'"),
    "missing key": Mistake("    baudrate: 1000000\n", "", 3, 3, "the key baudrate is missing"),
    "wrong version": Mistake("version: 1", "version: 2", 1, 10, "write `version: 1`"),
    "park without a pose": Mistake("id: 2,", "id: 2, on_exit: park,", 10, 7, "park needs a park_pose"),
    "unknown unit": Mistake("id: 2,", "id: 2, unit: feet,", 10, 28, "model sts has deg, rad, step"),
    "speed beyond the wire": Mistake("id: 2,", "id: 2, max_speed: 100000,", 10, 33, "model sts takes at most"),
    "tab": Mistake("    baudrate: 1000000", "\tbaudrate: 1000000", 6, 1, "found a tab; use spaces"),
    "alias": Mistake("    poll: {feedback: 50}", "    poll: *p", 7, 11, "found an alias"),
    "second document": Mistake("buses:\n", "---\nbuses:\n", 2, 1, "the border of a second document"),
    "rate of zero": Mistake("feedback: 50", "feedback: 0", 7, 22, "expected greater than 0"),
    "faults on a real line": Mistake(
        'port: "sim:"', "port: /dev/ttyS9\n    faults: {loss: 0.1}", 3, 3, "faults are for a simulated line"
    ),
    "limits beyond its reach": Mistake(
        "[-90, 90]", "[-90, 9000]", 9, 45, "buses.arm.servos.shoulder.limits: found 9000; model sts reaches -3059.91 to 2699.91"
    ),
    "too many limits": Mistake("[-90, 90]", "[-90, 0, 90]", 9, 45, "shoulder.limits: found 3 here; write at most 2"),
    "limits that are no list": Mistake("[-90, 90]", "90", 9, 45, "found 90; expected a list"),
    "number as a name": Mistake("elbow:", "7:", 10, 7, "found 7 as a name; put it in quotes"),
    "number as a bus": Mistake("  arm:", "  7:", 3, 3, "buses.7: found 7 as a name; put it in quotes"),
    "number as a port": Mistake('"sim:"', "7", 5, 11, "found 7; expected text; put a number in quotes"),
    "list as a port": Mistake('"sim:"', "[a]", 5, 5, "buses.arm.port: expected text"),
    "bad address": Mistake('port: "sim:"', "port: tcp://nowhere", 5, 11, "tcp://HOST:PORT"),
}
