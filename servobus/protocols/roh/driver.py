"""The ROH driver: what to say to hands and their fingers for each verb (seed 3 and 4). Sans-IO. Never seen on hardware.

A hand is a node, its fingers are servos. It has no ping, torque or stop command: ping reads a register, enabled is the host's
gate, and a stop writes where each finger is as its target.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from servobus.errors import DeviceError, LimitError, ServobusError, UnknownName
from servobus.protocols.base import Driver, GoalPlan, LineTraits, Plan, Poll, Request, ask
from servobus.protocols.modbus.codec import MAX_UNIT, Function
from servobus.protocols.modbus.requests import DEVICE_FAILURE, Fence, PresenceRead, RtuTiming
from servobus.protocols.roh import goals, stop
from servobus.protocols.roh.commissioning import Commissioning
from servobus.protocols.roh.finger import Finger
from servobus.protocols.roh.hand import FIRST, Hand, identity
from servobus.protocols.roh.model import RohModel
from servobus.protocols.roh.options import MAPS, RohBus
from servobus.protocols.roh.registers import NamedWrite, named_write, read_named
from servobus.protocols.roh.spans import Limits, Span, read_spans
from servobus.values import Identity, ServoGoal, StopReport, StopTarget, Update

TOLD = range(1, 10)
"""Fences of so many registers begin where the map is told; behind them stand registers that can only be written."""
ELSEWHERE = 1020
"""Longer fences begin here: the calibration and what follows can be read in every map."""
LONGEST_FENCE = 60
FENCE_TRIES = 2
HEALTH = ("status", "current")
SPAN = re.compile(r"(0[xX][0-9a-fA-F]+|\d+):(\d+)")


class RohDriver(Driver):
    """See `protocols.base.Driver`."""

    commissioning: Commissioning

    def __init__(self, options: RohBus, models: Mapping[str, RohModel]) -> None:
        self.options = options
        self.timing = RtuTiming.at(options.baudrate, options.turnaround_ms / 1000)
        self.limits = Limits(*options.limits(LineTraits()))
        self.fingers = {name: Finger(name, servo, models[servo.model]) for name, servo in options.servos.items()}
        self.nodes = {name: finger.node for name, finger in self.fingers.items()}
        self._models = models
        self.hands = {unit: self._hand(unit) for unit in dict.fromkeys(self.nodes.values())}
        self.commissioning = Commissioning(self._hand_of)
        # Requests are immutable, and the same few are said again and again.
        self._reads: dict[tuple[Hashable, ...], Request[Any]] = {}

    def _hand(self, unit: int) -> Hand:
        fingers = [finger for finger in self.fingers.values() if finger.node == unit]
        hand = Hand(unit, fingers, self.options.map_of(unit), self._models, self.timing, self.limits)
        hand.single_writes = self.options.single_write == "single"
        return hand

    def _hand_of(self, unit: int) -> Hand:
        return self.hands.get(unit) or self._hand(unit)

    def _of(self, servo: str) -> tuple[Finger, Hand]:
        finger = self.fingers[servo]
        return finger, self.hands[finger.node]

    def use_traits(self, traits: LineTraits) -> None:
        self.limits.read, self.limits.write = self.options.limits(traits)
        self._reads.clear()

    def explain(self, servo: str, error: DeviceError) -> Plan[DeviceError]:
        """A device failure has a reason, which the hand keeps in a register (seed 3.4)."""
        return self._of(servo)[1].explain(error)

    def step(self, servo: str) -> float:
        return self.fingers[servo].step

    # Who is there

    def ping(self, node: int) -> Request[int | None]:
        """Read the first register; a refusal is an answer too. There is no status byte."""
        return PresenceRead(self.timing, node, FIRST, 1, _nothing)

    def unused(self) -> Request[Any]:
        free = (unit for unit in range(MAX_UNIT, 0, -1) if unit not in self.hands)
        return Fence(self.timing, next(free, MAX_UNIT), FIRST, 1, _nothing, refusable=True)

    def fence(self, node: int, avoid: Sequence[Hashable], enabled: Collection[str]) -> Plan[bool]:
        """The map is looked at again on the way. A hand whose targets or settings are not what we left there has restarted."""
        hand = self._hand_of(node)
        used = [key[1][0] // 2 for key in avoid if isinstance(key, tuple) and key[0] == Function.READ_HOLDING]
        for attempt in range(FENCE_TRIES):
            fence = self._fence(node, used)
            try:
                heard = yield from ask(fence)
                break
            except ServobusError:
                if attempt == FENCE_TRIES - 1:
                    raise
                used.append(fence.count)
        if heard is not None and fence.address == FIRST and hand.doubts(heard):
            return not enabled
        return not enabled or (yield from self._kept(hand, enabled))

    def _fence(self, node: int, used: Sequence[int]) -> Fence[Sequence[int]]:
        count = fence_count(used, self.limits.read)
        address = FIRST if count in TOLD else ELSEWHERE
        return Fence(self.timing, node, address, count, list, refusable=not used)

    def _kept(self, hand: Hand, enabled: Collection[str]) -> Plan[bool]:
        """Whether the enabled fingers' registers still hold what we left there. A device failure is a hand that initialises."""
        wanted = {finger: (finger.target_name, *finger.settings) for finger in hand.fingers if finger.name in enabled}
        if not wanted:
            return True
        try:
            held = yield from hand.words(wanted)
        except DeviceError as error:
            return error.code != DEVICE_FAILURE
        if all(finger.kept(name, raw) for finger, name, raw in held):
            return True
        hand.forget()
        return False

    def inspect(self, node: int) -> Plan[Identity]:
        heard = yield from ask(self._hand_of(node).probe())
        return identity(heard, [self._models[name] for name in MAPS])

    def identify(self, servo: str) -> Plan[Identity]:
        """Asks for the map anew."""
        _, hand = self._of(servo)
        heard = yield from ask(hand.probe())
        hand.learn(heard)
        seen = identity(heard, [self._models[name] for name in MAPS])
        return replace(seen, notes=(hand.obstacle,) if hand.obstacle else ())

    # Reading

    def read_state(self, servo: str) -> Request[dict[str, Update]]:
        """Place, status and what stands between them, in one question; only the place, where the line does not carry that."""
        finger, hand = self._of(servo)
        model = hand.map
        known = self._reads.get((servo, model.name))
        if known is not None:
            return known
        place, status = finger.address(model, finger.place_name), finger.address(model, "status")
        start, end = min(place, status), max(place, status) + 1
        span = Span(start, end - start) if end - start <= self.limits.read else Span(place, 1)
        make = hand.trusted(model, lambda words: {servo: finger.decode(model, span, words)})
        request = self._reads[servo, model.name] = hand.read(span, make)
        return request

    def polls(self, rates: Mapping[str, float]) -> Sequence[Poll]:
        """Per hand: its fingers' places for feedback, status and current for health, each in the fewest reads. How many those are
        hangs on the map, which may be learned later; a poll that a map does not need asks nothing."""
        found = []
        for part, hz in rates.items():
            for unit, hand in self.hands.items():
                most = max(len(self._poll_spans(part, hand, self._models[name])) for name in MAPS)
                found += [Poll(part, hz, (unit,), partial(self._poll_request, part, hand, index)) for index in range(most)]
        return found

    def _poll_spans(self, part: str, hand: Hand, model: RohModel) -> list[Span]:
        addresses = {
            finger.address(model, name)
            for finger in hand.fingers
            for name in ((finger.place_name,) if part == "feedback" else HEALTH)
        }
        return read_spans(addresses, self.limits.read)

    def _poll_request(self, part: str, hand: Hand, index: int, reachable: Collection[int]) -> Request[dict[str, Update]] | None:
        if hand.unit not in reachable:
            return None
        model = hand.map
        key = (part, hand.unit, index, model.name)
        if key not in self._reads:
            spans = self._poll_spans(part, hand, model)
            if index >= len(spans):
                return None
            span = spans[index]
            self._reads[key] = hand.read(span, lambda words: hand.updates(model, span, words, hand.fingers))
        return self._reads[key]

    def read_register(self, servo: str, register: str, *, raw: bool = False) -> Request[Any]:
        """A number or a word for one register, a list for a register of several words, or for ADDR:LEN."""
        finger, hand = self._of(servo)
        model = hand.map
        key = (servo, register, raw, model.name)
        if key not in self._reads:
            match = SPAN.fullmatch(register)
            span = self._free_span(int(match[1], 0), int(match[2])) if match else None
            self._reads[key] = hand.read(span, list) if span else read_named(finger, hand, model, register, raw=raw)
        return self._reads[key]

    def _free_span(self, address: int, count: int) -> Span:
        if not (1 <= count <= self.limits.read and address + count <= 0x10000):
            raise LimitError(f"{address}:{count} is no span this line can carry: give ADDR:LEN with LEN up to {self.limits.read}")
        return Span(address, count)

    # Writing

    def write_register(self, servo: str, register: str, value: Any, *, raw: bool = False, persist: bool = False) -> Plan[Any]:
        finger, hand = self._of(servo)
        return self._write(named_write(finger, hand, register, value, raw=raw, persist=persist), raw=raw)

    @staticmethod
    def _write(write: NamedWrite, *, raw: bool) -> Plan[Any]:
        yield from write.hand.explained(write.send())
        return write.count if raw else write.finger.to_physical(write.register, write.count)

    # Motion

    def enable(self, servo: str) -> Plan[float | None]:
        """Opens the host's gate. Writes nothing: a finger holds its target anyhow, and there is no torque command. What the hand
        holds is learned, so that a later restart shows. Raises DeviceError where the map is not the right one."""
        finger, hand = self._of(servo)
        finger.forget()
        yield from hand.attach()
        names = [finger.place_name, finger.target_name, "speed"]
        names += ["current_limit"] if finger.options.torque_limit is not None else []
        held = yield from hand.explained(hand.words({finger: names}))
        for _, name, raw in held[1:]:
            finger.learn(name, raw)
        finger.enabled = True
        return finger.calibration.to_unit(held[0][2])

    def disable(self, servo: str) -> Plan[StopReport]:
        return stop.disable(self.fingers[servo])

    def stop(self, targets: Sequence[StopTarget]) -> Plan[dict[str, StopReport]]:
        return stop.stop(self.hands, [(self.fingers[target.servo], target) for target in targets])

    def check_goal(self, goal: ServoGoal) -> None:
        if goal.servo not in self.fingers:
            raise UnknownName(f"no servo {goal.servo} on this bus")
        finger, hand = self._of(goal.servo)
        if hand.obstacle:
            raise DeviceError(hand.obstacle, servo=goal.servo)
        start = goal if goal.start is not None else replace(goal, start=goal.goal.value)
        finger.target(hand.map, start)
        finger.wanted_settings(hand.map, start)

    def host_speed(self, goal: ServoGoal) -> float | None:
        """The hand keeps the speed that stands in its register."""
        return None

    def plan_goals(self, goals_: Sequence[ServoGoal], *, together: bool, confirm: bool) -> Sequence[GoalPlan]:
        """Every write is acknowledged with its address and number, asked for or not."""
        parts = goals.by_hand(self.hands, [(self.fingers[goal.servo], goal) for goal in goals_])
        return goals.turns(parts, together=together)

    def fault_names(self, servo: str, status: int | None) -> tuple[str, ...]:
        """Of the finger's own status, and of the host's finding that the map does not fit."""
        finger, hand = self._of(servo)
        mismatch = ("register_map",) if hand.obstacle else ()
        return (*finger.faults(hand.map, status), *mismatch)


def fence_count(used: Sequence[int], limit: int) -> int:
    """Registers to read that no answer under way can bring; when all are taken, those asked for longest ago (`used` is oldest
    first)."""
    counts = range(1, min(limit, LONGEST_FENCE) + 1)
    free = (count for count in counts if count not in used)
    return next(free, None) or next(count for count in used if count in counts)


def _nothing(words: Sequence[int]) -> int | None:
    return None
