"""Translates a Modbus-RTU request into the arm's commands that carry it, and their replies into the Modbus reply. Sans-IO."""

from __future__ import annotations

from collections import deque

from servobus.protocols.modbus.codec import REFUSED, Frame, Function, encode, pack, unpack
from servobus.protocols.modbus.requests import NO_ANSWER
from servobus.protocols.realman.codec import ArmCommand, Dialect


class TunnelRequest:
    """One Modbus request. `commands` are those that still have to be sent."""

    def __init__(self, frame: Frame, dialect: Dialect) -> None:
        self._frame = frame
        self._registers: list[int] = []
        self.commands: deque[ArmCommand] = deque()
        unit = frame.unit
        address, second = unpack(frame.data[:4])
        if frame.function == Function.READ_HOLDING:
            for at in range(0, second, dialect.max_read):
                self.commands.append(dialect.read(unit, address + at, min(dialect.max_read, second - at)))
            return
        values = [second] if frame.function == Function.WRITE_SINGLE else unpack(frame.data[5:])
        for at in range(0, len(values), dialect.max_write):
            self.commands.append(dialect.write(unit, address + at, values[at : at + dialect.max_write]))

    def take(self, registers: list[int] | None) -> bytes | None:
        """Take the result of the next command; None means that the arm reports a failure.

        Returns the Modbus reply after the last command or a failure, else None. A failure becomes the exception "gateway: the
        unit did not answer", because the arm does not say why.
        """
        self.commands.popleft()
        frame = self._frame
        if registers is None:
            self.commands.clear()
            return encode(frame.unit, frame.function | REFUSED, bytes((NO_ANSWER,)))
        self._registers += registers
        if self.commands:
            return None
        if frame.function == Function.READ_HOLDING:
            return encode(frame.unit, frame.function, bytes((2 * len(self._registers),)) + pack(self._registers))
        return encode(frame.unit, frame.function, frame.data[:4])
