"""One hand on the line: which register map it has, and what it means when it refuses.

The map is asked for when the hand is met (high byte of register 1000), because one number is a speed in one map and a target in
another. Until it is known, and while it is not the pinned one, nothing is written.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TypeVar

from servobus.errors import DeviceError, ServobusError
from servobus.protocols.base import Plan, Request, ask
from servobus.protocols.modbus.requests import DEVICE_FAILURE, NO_ANSWER, ReadHolding, RtuTiming, WriteMultiple, WriteSingle
from servobus.protocols.roh.finger import Finger
from servobus.protocols.roh.model import RohModel
from servobus.protocols.roh.model_loading import NEWEST
from servobus.protocols.roh.options import MAPS
from servobus.protocols.roh.spans import Limits, Span, read_spans
from servobus.values import Identity, Update

R = TypeVar("R")

FIRST = 1000
"""Where the registers begin that tell the map."""
SEEN = 4
"""Of them, as many as a person wants to know."""
SUB_EXCEPTIONS = {
    1: "it is still initialising: wait, then try again",
    2: "it waits for its calibration: finish that first",
    3: "it does not take that value",
    4: "a motor is stuck: free the finger",
    5: "the operation failed",
    6: "saving failed",
}
"""Seed 3.4."""
HARDWARE = {0x1B: "ROH-A001 or A002", 0x20: "ROH-AP001", 0x25: "ROH-LiteS001"}
"""High byte of the hardware version."""


class Hand:
    """One unit. `limits` are the line's, shared with all hands."""

    def __init__(
        self,
        unit: int,
        fingers: Sequence[Finger],
        pinned: str,
        models: Mapping[str, RohModel],
        timing: RtuTiming,
        limits: Limits,
    ) -> None:
        self.unit = unit
        self.fingers = fingers
        self.pinned = pinned
        self.timing = timing
        self.limits = limits
        self.single_writes = False
        """0x06 for single registers."""
        self._models = models
        self.found: RohModel | None = None
        """The map it says it has."""
        self.obstacle = "it was not asked yet for its register map: is it powered, are id and baud rate right?"
        """Why nothing may be written to it; empty: it may."""

    @property
    def map(self) -> RohModel:
        """What to read by. While it is not known: a map to plan with, whose values nobody believes (see `trusted`)."""
        return self.found or self._models[NEWEST if self.pinned == "auto" else self.pinned]

    # Which map

    def probe(self) -> ReadHolding[Sequence[int]]:
        return ReadHolding(self.timing, self.unit, FIRST, SEEN, list)

    def attach(self) -> Plan[None]:
        """Ask for the map where it is not known. Raises DeviceError where nothing may be written."""
        if self.found is None:
            heard = yield from ask(self.probe())
            if heard:
                self.learn(heard)
            else:  # a preview: nothing is sent and nothing is heard, so any map will do
                self.found, self.obstacle = self.map, ""
        self.require()

    def learn(self, heard: Sequence[int]) -> None:
        """What registers 1000 and 1001 bring."""
        before, self.found = self.found, next((model for model in self._maps() if model.fits(heard)), None)
        if before is not None and self.found is not before:
            self.forget()
        if self.found is None:
            first, second = heard[:2]
            self.obstacle = (
                f"its registers 1000 and 1001 read 0x{first:04X} and 0x{second:04X}, none of the maps {', '.join(MAPS)}: "
                "nothing is written to it. Is its firmware one for another protocol?"
            )
        elif self.pinned not in ("auto", self.found.name):
            self.obstacle = (
                f"it has the register map {self.found.name}, the config pins {self.pinned}: nothing is written to it. "
                f"Set units: {{{self.unit}: {{model: {self.found.name}}}}}"
            )
        else:
            self.obstacle = ""

    def doubts(self, heard: Sequence[int]) -> bool:
        """A fence brought the first registers again: whether it is another hand now. Then it is to be asked anew."""
        if self.found is None or self.found.fits(heard):
            return False
        self.found = None
        self.obstacle = "another hand answers in its place: it was not asked yet for its register map"
        self.forget()
        return True

    def forget(self) -> None:
        for finger in self.fingers:
            finger.forget()

    def require(self) -> None:
        """Raises DeviceError where nothing may be written."""
        if self.obstacle:
            raise DeviceError(self.obstacle)

    def _maps(self) -> Iterable[RohModel]:
        return (self._models[name] for name in MAPS)

    # Reading and writing

    def read(self, span: Span, make: Callable[[Sequence[int]], R]) -> ReadHolding[R]:
        return ReadHolding(self.timing, self.unit, span.start, span.count, make)

    def write(self, address: int, words: Sequence[int], *, repeat: bool = True) -> Request[None]:
        if self.single_writes and len(words) == 1:
            return WriteSingle(self.timing, self.unit, address, words[0], repeat=repeat)
        return WriteMultiple(self.timing, self.unit, address, words, repeat=repeat)

    def trusted(self, model: RohModel, make: Callable[[Sequence[int]], R]) -> Callable[[Sequence[int]], R]:
        """Of an answer to a read by this map, if it turned out to be the right one. Else DeviceError."""

        def trust(words: Sequence[int]) -> R:
            if self.found is not model:
                raise DeviceError(self.obstacle or f"it turned out to have the register map {self.map.name}: ask again")
            return make(words)

        return trust

    def updates(self, model: RohModel, span: Span, words: Sequence[int], fingers: Sequence[Finger]) -> dict[str, Update]:
        """What a poll brings; nothing by a map that is not the hand's."""
        if self.found is not model:
            return {}
        return {finger.name: update for finger in fingers if (update := finger.decode(model, span, words))}

    def words(self, names: Mapping[Finger, Sequence[str]]) -> Plan[list[tuple[Finger, str, int]]]:
        """Raw values of some registers of some fingers, in the fewest reads."""
        model = self.map
        wanted = [(finger, name, finger.address(model, name)) for finger, some in names.items() for name in some]
        heard: dict[int, int] = {}
        for span in read_spans((address for _, _, address in wanted), self.limits.read):
            found = (yield from ask(self.read(span, list))) or [0] * span.count  # a preview hears nothing
            heard.update(zip(range(span.start, span.end), found, strict=True))
        return [(finger, name, model.named(name).raw(heard[address])) for finger, name, address in wanted]

    # Refusals

    def explained(self, plan: Plan[R]) -> Plan[R]:
        """The plan; a device failure, and a gateway's no, is followed by the question why, once (seed 3.4)."""
        try:
            return (yield from plan)
        except DeviceError as error:
            raise (yield from self.explain(error)) from None

    def explain(self, error: DeviceError) -> Plan[DeviceError]:
        if error.code not in (DEVICE_FAILURE, NO_ANSWER):
            return error
        address = self.map.named("sub_exception").address
        try:
            (code,) = yield from ask(self.read(Span(address, 1), list))
        except ServobusError:
            return error
        if not code:
            return error
        meaning = SUB_EXCEPTIONS.get(code, "a sub-exception no document names")
        certain = "" if error.code == DEVICE_FAILURE else "its last sub-exception: "
        return DeviceError(
            f"{error.message}; {certain}{meaning} ({code})",
            code=error.code,
            request=error.request,
            raw=error.raw,
            servo=error.servo,
        )


def identity(heard: Sequence[int], models: Iterable[RohModel]) -> Identity:
    """Who it is, of its first registers."""
    model = next((model for model in models if model.fits(heard)), None)
    if model is None:
        return Identity(product=f"unknown map: registers 1000 and 1001 read 0x{heard[0]:04X}, 0x{heard[1]:04X}")
    place = model.named("fw_version").address - FIRST
    firmware, revision, hardware = heard[place], heard[place + 1], heard[place + 2]
    product = HARDWARE.get(hardware >> 8, f"ROH hardware 0x{hardware:04X}")
    return Identity(model=model.name, product=product, firmware=f"{firmware >> 8}.{firmware & 0xFF}.{revision}", mode="position")
