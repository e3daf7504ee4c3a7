"""A Modbus-RTU question as the commands that carry it through an arm, and their answers as the frame that answers it. Sans-IO."""

from __future__ import annotations

from collections import deque

from servobus.protocols.modbus.codec import REFUSED, Frame, Function, encode, pack, words
from servobus.protocols.modbus.requests import NO_ANSWER
from servobus.protocols.realman.codec import Dialect, Step


class Question:
    """One Modbus question as the commands that carry it."""

    def __init__(self, frame: Frame, dialect: Dialect) -> None:
        self._frame = frame
        self._words: list[int] = []
        self.steps: deque[Step] = deque()
        unit = frame.unit
        address, second = words(frame.body[:4])
        if frame.function == Function.READ_HOLDING:
            for at in range(0, second, dialect.max_read):
                self.steps.append(dialect.read(unit, address + at, min(dialect.max_read, second - at)))
            return
        values = [second] if frame.function == Function.WRITE_SINGLE else words(frame.body[5:])
        for at in range(0, len(values), dialect.max_write):
            self.steps.append(dialect.write(unit, address + at, values[at : at + dialect.max_write]))

    def take(self, found: list[int] | None) -> bytes | None:
        """The answer of the next command; the frame that answers the question, when that was the last, or it failed."""
        self.steps.popleft()
        frame = self._frame
        if found is None:
            self.steps.clear()
            return encode(frame.unit, frame.function | REFUSED, bytes((NO_ANSWER,)))
        self._words += found
        if self.steps:
            return None
        if frame.function == Function.READ_HOLDING:
            return encode(frame.unit, frame.function, bytes((2 * len(self._words),)) + pack(self._words))
        return encode(frame.unit, frame.function, frame.body[:4])
