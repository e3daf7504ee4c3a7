"""The ROH driver: which requests each verb of hands and fingers takes (ROH Modbus, 3 and 4). Sans-IO. Not tried on hardware yet.

A hand is a node, and its fingers are servos. A hand has no ping, torque or stop command. So a ping reads a register, `enable`
moves nothing and lets goals pass, and a stop writes each finger's present position as its target.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from servobus.errors import DeviceError, ServobusError, UnknownName
from servobus.protocols import fence
from servobus.protocols.base import Driver, GoalPlan, LineTraits, Plan, Poll, Request, ask
from servobus.protocols.modbus.codec import MAX_UNIT, Function, reply_key
from servobus.protocols.modbus.requests import Fence, PresenceRead, RtuTiming
from servobus.protocols.roh import enabling, goals, stop
from servobus.protocols.roh.commissioning import RohCommissioning
from servobus.protocols.roh.finger import Finger
from servobus.protocols.roh.hand import FIRST, Hand, identity
from servobus.protocols.roh.model import RohModel
from servobus.protocols.roh.options import MAPS, RohBus
from servobus.protocols.roh.registers import NamedWrite, named_write, read_named
from servobus.protocols.roh.spans import Limits, Span, read_spans
from servobus.protocols.spans import parse_span
from servobus.values import Identity, Loss, ServoGoal, StopReport, StopTarget, Update

IDENTITY_FENCES = range(1, 10)
"""Fences of so many registers begin at the first one; behind them are registers that can only be written."""
OTHER_FENCES = 1020
"""Longer fences begin here: the calibration and what follows can be read in every map."""
MAX_FENCE = 60
HEALTH = ("status", "current", "speed")
"""The speed shows a restart."""


class RohDriver(Driver):
    """The driver of a line of hands; see `protocols.base.Driver`."""

    commissioning: RohCommissioning

    def __init__(self, options: RohBus, models: Mapping[str, RohModel]) -> None:
        self.options = options
        self.timing = RtuTiming.at(options.baudrate, options.turnaround_ms / 1000)
        self.limits = Limits(*options.limits(LineTraits()))
        self.fingers = {name: Finger(name, servo, models[servo.model]) for name, servo in options.servos.items()}
        self.nodes = {name: finger.node for name, finger in self.fingers.items()}
        self._models = models
        self.hands = {unit: self._make_hand(unit) for unit in dict.fromkeys(self.nodes.values())}
        self.commissioning = RohCommissioning(self._hand_of)
        # Requests are immutable, so each is made once.
        self._reads: dict[tuple[Hashable, ...], Request[Any]] = {}

    def _make_hand(self, unit: int) -> Hand:
        fingers = [finger for finger in self.fingers.values() if finger.node == unit]
        single_writes = self.options.single_write == "single"
        pinned = self.options.map_of(unit)
        return Hand(unit, fingers, pinned, self._models, self.timing, self.limits, single_writes=single_writes)

    def _hand_of(self, unit: int) -> Hand:
        return self.hands.get(unit) or self._make_hand(unit)

    def _of(self, servo: str) -> tuple[Finger, Hand]:
        finger = self.fingers[servo]
        return finger, self.hands[finger.node]

    def use_traits(self, traits: LineTraits) -> None:
        self.limits.read, self.limits.write = self.options.limits(traits)
        self._reads.clear()

    def use_options(self, options: RohBus) -> bool:
        if not self.options.is_live_change(options):
            return False
        self.options = options
        for name, finger in self.fingers.items():
            finger.use_options(options.servos[name])
        return True

    def explain(self, servo: str, error: DeviceError) -> Plan[DeviceError]:
        """Ask for the reason of a device failure, which the hand keeps in a register (ROH Modbus, 3.4)."""
        return self._of(servo)[1].explain(error)

    def step(self, servo: str) -> float:
        return self.fingers[servo].step

    # Addressing

    def ping(self, node: int) -> Request[int | None]:
        """Return a read of the first register. A refusal is an answer too; there is no status byte."""
        return PresenceRead(self.timing, node, FIRST, 1, _nothing)

    def unused(self) -> Request[Any]:
        free = (unit for unit in range(MAX_UNIT, 0, -1) if unit not in self.hands)
        return Fence(self.timing, next(free, MAX_UNIT), FIRST, 1, _nothing, refusable=True)

    def fence(self, node: int, avoid: Sequence[Hashable], enabled: Collection[str]) -> Plan[bool]:
        """Read a number of registers that no reply under way can have, then check what the enabled fingers' registers hold.

        A short fence reads the map as well, which shows another hand in its place. A hand whose targets or settings are not what
        was written there has restarted.
        """
        hand = self._hand_of(node)
        under_way: list[Hashable] = [key for key in avoid if isinstance(key, tuple) and key[0] == Function.READ_HOLDING]

        def attempt(key: Hashable) -> Plan[Sequence[int]]:
            request = self._fence(node, self._fence_keys().index(key) + 1, refusable=not under_way)
            under_way.append(key)
            registers = yield from ask(request)
            return registers if registers is not None and request.address == FIRST else ()

        registers = yield from fence.fence(attempt, self._fence_keys(), avoid)
        if registers and hand.is_replaced(registers):
            return not enabled
        return not enabled or (yield from self._is_unchanged(hand, enabled))

    def _fence_keys(self) -> list[Hashable]:
        """Return the reply key of a read of 1, 2, 3 ... registers."""
        counts = range(1, min(self.limits.read, MAX_FENCE) + 1)
        return [reply_key(Function.READ_HOLDING, bytes((2 * count,))) for count in counts]

    def _fence(self, node: int, count: int, *, refusable: bool) -> Fence[Sequence[int]]:
        address = FIRST if count in IDENTITY_FENCES else OTHER_FENCES
        return Fence(self.timing, node, address, count, list, refusable=refusable)

    def _is_unchanged(self, hand: Hand, enabled: Collection[str]) -> Plan[bool]:
        """Return whether the enabled fingers show that their hand has not restarted."""
        fingers = [finger for finger in hand.fingers if finger.name in enabled]
        try:
            return (yield from hand.is_kept(_evidence(hand, fingers)))
        except DeviceError:
            return True  # it answers, and does not report these registers

    def inspect(self, node: int) -> Plan[Identity]:
        registers = yield from ask(self._hand_of(node).identity_read())
        return identity(registers, [self._models[name] for name in MAPS])

    def identify(self, servo: str) -> Plan[Identity]:
        """Ask the hand for its map again."""
        _, hand = self._of(servo)
        registers = yield from ask(hand.identity_read())
        hand.learn(registers)
        result = identity(registers, [self._models[name] for name in MAPS])
        obstacle = hand.fit.obstacle
        return replace(result, notes=(obstacle,) if obstacle else (), obstacle=obstacle)

    # Reading

    def read_state(self, servo: str) -> Request[dict[str, Update]]:
        """Return the read of position, status and what lies between; only of the position where the line cannot carry that.

        A hand that cannot be read across a gap brings the position and what lies between that and the speed.
        """
        finger, hand = self._of(servo)
        model = hand.map
        key = (servo, model.name, hand.fit.gap)
        if key not in self._reads:
            position = finger.address(model, finger.position_name)
            other = finger.address(model, "status" if hand.fit.gap is None else "speed")
            start, end = min(position, other), max(position, other) + 1
            span = Span(start, end - start) if end - start <= self.limits.read else Span(position, 1)
            make = hand.trusted(model, lambda registers: {servo: finger.decode(model, span, registers)})
            self._reads[key] = hand.read_state(span, make)
        return self._reads[key]

    def polls(self, rates: Mapping[str, float]) -> Sequence[Poll]:
        """Return the fewest reads for each hand: positions for feedback, status, current and speed for health.

        How many they are depends on the map, which may be learned later. A poll that a map does not need makes no request.
        """
        polls = []
        for part, hz in rates.items():
            for unit, hand in self.hands.items():
                models = [self._models[name] for name in MAPS]
                count = max(len(self._poll_spans(part, hand, model, gap)) for model in models for gap in (None, model.lite_gap))
                polls += [Poll(part, hz, (unit,), partial(self._poll_request, part, hand, index)) for index in range(count)]
        return polls

    def _poll_spans(self, part: str, hand: Hand, model: RohModel, gap: int | None) -> list[Span]:
        addresses = {
            finger.address(model, name)
            for finger in hand.fingers
            for name in ((finger.position_name,) if part == "feedback" else HEALTH)
        }
        return read_spans(addresses, self.limits.read, gap)

    def _poll_request(self, part: str, hand: Hand, index: int, reachable: Collection[int]) -> Request[dict[str, Update]] | None:
        if hand.unit not in reachable:
            return None
        model = hand.map
        key = (part, hand.unit, index, model.name, hand.fit.gap)
        if key not in self._reads:
            spans = self._poll_spans(part, hand, model, hand.fit.gap)
            if index >= len(spans):
                return None
            span = spans[index]
            self._reads[key] = hand.read_state(span, lambda registers: hand.updates(model, span, registers, hand.fingers))
        return self._reads[key]

    def read_register(self, servo: str, register: str, *, raw: bool = False) -> Request[Any]:
        """Return a read of one register, whose value is a number or text; a list for a longer register, and for ADDR:LEN."""
        finger, hand = self._of(servo)
        model = hand.map
        key = (servo, register, raw, model.name)
        if key not in self._reads:
            span = parse_span(register, table_size=0x10000, max_count=self.limits.read, servo=servo)
            self._reads[key] = hand.read(Span(*span), list) if span else read_named(finger, hand, model, register, raw=raw)
        return self._reads[key]

    # Writing

    def write_register(self, servo: str, register: str, value: Any, *, raw: bool = False, persist: bool = False) -> Plan[Any]:
        finger, hand = self._of(servo)
        return self._write(named_write(finger, hand, register, value, raw=raw, persist=persist), raw=raw)

    @staticmethod
    def _write(write: NamedWrite, *, raw: bool) -> Plan[Any]:
        yield from write.hand.explained(write.send())
        return write.raw if raw else write.finger.to_physical(write.register, write.raw)

    # Motion

    def enable(self, servo: str) -> Plan[float | None]:
        finger, hand = self._of(servo)
        return hand.explained(enabling.enable(hand, finger))

    def verify(self, servos: Sequence[str]) -> Plan[Mapping[str, Loss]]:
        """Read the speeds of these fingers, one read for each hand; and their targets, where the same read brings them."""
        lost: dict[str, Loss] = {}
        for unit in dict.fromkeys(self.nodes[servo] for servo in servos):
            hand = self.hands[unit]
            fingers = [self.fingers[servo] for servo in servos if self.nodes[servo] == unit]
            try:
                kept = yield from hand.is_kept(_evidence(hand, fingers))
            except ServobusError:
                continue  # it did not show how it is; one that did not answer is doubtful now
            if not kept:
                lost |= {finger.name: Loss.RESTARTED for finger in fingers}
        return lost

    def disable(self, servo: str) -> Plan[StopReport]:
        finger, hand = self._of(servo)
        return stop.disable(hand, finger)

    def stop(self, targets: Sequence[StopTarget]) -> Plan[dict[str, StopReport]]:
        return stop.stop(self.hands, [(self.fingers[target.servo], target) for target in targets])

    def check_goal(self, goal: ServoGoal) -> None:
        if goal.servo not in self.fingers:
            raise UnknownName(f"no servo {goal.servo} on this bus")
        finger, hand = self._of(goal.servo)
        if hand.fit.obstacle:
            raise DeviceError(hand.fit.obstacle, servo=goal.servo)
        start = goal if goal.start is not None else replace(goal, start=goal.goal.value)
        finger.target(hand.map, start)
        finger.wanted_settings(hand.map, start)

    def plan_goals(self, goals_: Sequence[ServoGoal], *, together: bool, confirm: bool) -> Sequence[GoalPlan]:
        """Return one plan for each hand, or one for all. Every write is acknowledged, with or without `confirm`."""
        parts = goals.by_hand(self.hands, [(self.fingers[goal.servo], goal) for goal in goals_])
        return goals.plan_hands(parts, together=together)

    def preview_goals(self, goals_: Sequence[ServoGoal]) -> Sequence[Request[Any]]:
        return self._preview(goal.servo for goal in goals_)

    def preview_stop(self, targets: Sequence[StopTarget]) -> Sequence[Request[Any]]:
        return self._preview(target.servo for target in targets)

    def _preview(self, servos: Iterable[str]) -> list[Request[Any]]:
        """Return the writes of these fingers' targets, by the map that the config names or the newest one."""
        names = set(servos)
        fingers = {unit: [finger for finger in hand.fingers if finger.name in names] for unit, hand in self.hands.items()}
        return [request for unit, some in fingers.items() for request in goals.target_writes(self.hands[unit], some)]

    def fault_names(self, servo: str, status: int | None) -> tuple[str, ...]:
        """Return the fault in the finger's status, and `register_map` where nothing may be written to the hand."""
        finger, hand = self._of(servo)
        mismatch = ("register_map",) if hand.fit.obstacle else ()
        return (*finger.faults(hand.map, status), *mismatch)


def _nothing(registers: Sequence[int]) -> int | None:
    return None


def _evidence(hand: Hand, fingers: Sequence[Finger]) -> dict[Finger, tuple[str, ...]]:
    """Return the registers that show whether the hand has restarted."""
    addresses = [finger.address(hand.map, name) for finger in fingers for name in ("speed", finger.target_name)]
    if len(hand.spans(addresses)) == 1:
        return {finger: ("speed", finger.target_name) for finger in fingers}
    return dict.fromkeys(fingers, ("speed",))
